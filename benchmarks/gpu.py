"""One sweep on an accelerator: `python -m benchmarks.gpu --json F`.

Correctness first (torques against float64 on the host), then the controller's and the
environment's throughput, PPO's, and one learning run. MJX physics throughout.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import envs
import rmp_mjx as rmp
from benchmarks.common import Row, measure, show, write_json
from rmp_mjx import runtime
from rmp_mjx.training import evaluate
from rmp_mjx.training.config import TrainConfig
from rmp_mjx.training.networks import make_agent
from rmp_mjx.training.ppo import make_ppo


def scene(robot: rmp.Robot, batch: int):
    """Random states near home, set-points, five spheres and the table."""
    rng = np.random.default_rng(0)
    q = robot.q_home + rng.uniform(-0.7, 0.7, (batch, robot.n))
    qd = rng.normal(size=(batch, robot.n))
    action = rng.uniform(-1.0, 1.0, (batch, rmp.ACTION_SIZE))
    centers = rng.uniform([0.2, -0.4, 0.0], [0.6, 0.4, 0.5], (5, 3))
    return q, qd, action, centers


def torques(ctrl: rmp.RMPVICES, centers):
    """The batched controller from states and policy actions."""
    obstacles = rmp.Obstacles.empty(spheres=5, planes=1).with_spheres(centers, 0.05)
    obstacles = obstacles.with_planes([[0.0, 0.0, -0.112]], [[0.0, 0.0, 1.0]])

    def act(q, qd, action):
        return ctrl(q, qd, ctrl.setpoint(q, ctrl.decode(action)), obstacles).tau

    return jax.vmap(act)


def correctness(robot: rmp.Robot) -> list[Row]:
    """Float32 torques on this device against float64 on the host's CPU."""
    q, qd, action, centers = scene(robot, 1000)
    single = [jnp.asarray(x, jnp.float32) for x in (q, qd, action)]
    ctrl = rmp.RMPVICES(robot)
    tau = np.asarray(jax.jit(torques(ctrl, centers))(*single))
    with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
        double = [jnp.asarray(np.asarray(x), jnp.float64) for x in single]
        exact = np.asarray(jax.jit(torques(ctrl, centers))(*double))
    error = np.abs(tau - exact).max(axis=1) / np.abs(exact).max(axis=1)
    note = "largest joint error over the largest torque, 1,000 states, 5 spheres"
    return [
        Row("torque_error_median", float(np.median(error)), "-", note),
        Row("torque_error_p99", float(np.percentile(error, 99)), "-", note),
    ]


def controller(robot: rmp.Robot, batches: Sequence[int]) -> list[Row]:
    """Tree evaluations per second."""
    rows = []
    for batch in batches:
        q, qd, action, centers = scene(robot, batch)
        states = [jnp.asarray(x, jnp.float32) for x in (q, qd, action)]
        timing = measure(torques(rmp.RMPVICES(robot), centers), *states, seconds=2.0)
        rows.append(
            Row(
                f"controller_evals_per_s_batch{batch}",
                batch / timing.median,
                "1/s",
                f"{len(robot.points.segment)} points; {timing.spread}",
            )
        )
    return rows


def environment(name: str, batches: Sequence[int]) -> list[Row]:
    """Policy steps per second under random actions."""
    env = envs.load("trajectory", controller=name, physics="mjx")
    rows = []
    for batch in batches:
        state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), batch))
        shape = (batch, env.action_size)
        action = jax.random.uniform(jax.random.key(1), shape, minval=-1.0)
        timing = measure(jax.vmap(env.step), state, action, seconds=3.0)
        rows.append(
            Row(
                f"env_steps_per_s_mjx_{name}_{batch}",
                batch / timing.median,
                "1/s",
                f"{env.n_substeps} substeps; compile {timing.compile_s:.0f} s; "
                + timing.spread,
            )
        )
    return rows


def learning(num_envs: int, steps: int) -> list[Row]:
    """Train RMP-VICES on trajectory following and evaluate it."""
    config = TrainConfig(
        physics="mjx", num_envs=num_envs, num_timesteps=steps, num_minibatches=16
    )
    env = envs.load("trajectory", controller="rmp_vices", physics="mjx")
    ppo = make_ppo(env, config)
    state = jax.jit(ppo.init)(jax.random.key(0))
    start = time.monotonic()
    iterate = jax.jit(ppo.iterate).lower(state).compile()
    compile_s = time.monotonic() - start
    times, events = [], 0.0
    for _ in range(config.num_iterations):
        start = time.monotonic()
        state, stats, _ = jax.block_until_ready(iterate(state))
        times.append(time.monotonic() - start)
        events += sum(float(stats.step_sums[k]) for k in ("collision", "joint_limit"))
    agent = make_agent(ppo.networks, state.normalizer, state.learner.policy, True)
    results = evaluate.run_episodes(env, agent, 1000, jax.random.key(1))
    summary = evaluate.summarise(results, env.metric_reductions)
    note = f"{num_envs} envs, {config.num_iterations} iterations, seed 0"
    rate = config.steps_per_iteration / float(np.median(times))
    return [
        Row("ppo_steps_per_s_mjx", rate, "1/s", "updates included; " + note),
        Row("ppo_compile_s", compile_s, "s", note),
        Row("ppo_train_s", sum(times), "s", f"{steps} policy steps; " + note),
        Row("train_events", events, "-", "collisions and joint limits; " + note),
        Row("eval_success_rate", summary["success_rate"], "-", "1,000 episodes"),
        Row("eval_collision_rate", summary["collision_rate"], "-", "1,000 episodes"),
        Row("eval_limit_rate", summary["joint_limit_rate"], "-", "1,000 episodes"),
    ]


def main(args: Sequence[str] | None = None) -> None:
    """Run the sweep, writing after every part."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--quick", action="store_true", help="small sizes")
    options = parser.parse_args(args)
    runtime.configure()
    robot = rmp.Robot.load("jaco2")
    small = options.quick
    rows: list[Row] = []
    for part in (
        lambda: correctness(robot),
        lambda: controller(robot, [256] if small else [1, 2048, 8192, 32768]),
        lambda: environment("rmp_vices", [64] if small else [8192]),
        lambda: learning(64 if small else 4096, 2048 if small else 4_000_000),
        lambda: environment("rmp_vices", [] if small else [32768, 2048]),
        lambda: environment("vices", [] if small else [8192]),
    ):
        rows += part()
        show(rows, "accelerator sweep")
        write_json(options.json, rows, quick=small)


if __name__ == "__main__":
    main()
