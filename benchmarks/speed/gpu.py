"""One sweep on an accelerator: `python -m benchmarks.gpu --json F`.

Torques are checked first, against float64 on the host's CPU. Then follow the throughput
of the controller and of the environment on MJX and, if it is installed, on Warp, and of
PPO with one learning run each. Each part is a process. All compile at the same time and
measure in turn, so that the sweep takes minutes. A part's rows are written at once; a
part that fails says why and does not stop the others. `--grid` does the same for the
cells of the paper's grid.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import (
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    as_completed,
)
from functools import partial
from pathlib import Path
from threading import Barrier, Lock
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
import rmp_mjx as rmp
from benchmarks.common import Row, Timing, show, time_calls, write_json
from benchmarks.paper import cells
from benchmarks.paper.cells import PRESETS, Cell, Preset
from envs.scene import TABLE_HEIGHT
from rmp_mjx import runtime, sim
from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.evaluation import evaluate
from rmp_mjx.training.learning import seeds
from rmp_mjx.training.learning.networks import make_agent
from rmp_mjx.training.learning.ppo import make_ppo

ITERATIONS = 20
"""Iterations by which a cell of the grid is timed."""

Part = Callable[[], list[Row]]
"""Measures a compiled part."""


class Programs:
    """Compiles several programs at once: tracing takes turns, the compiler does not."""

    def __init__(self):
        self._pool = ThreadPoolExecutor()

    def add(self, function: Callable[..., Any], *args: Any) -> Future:
        """Start to compile; the future gives the program and its compile time [s].

        Args:
            function: What to jit.
            *args: Its arguments, or their shapes.
        """
        start = time.perf_counter()
        lowered = jax.jit(function).lower(*args)

        def finish():
            return lowered.compile(), time.perf_counter() - start

        return self._pool.submit(finish)


def scene(robot: rmp.Robot, batch: int):
    """Random states near home, actions, and the centres of five spheres."""
    rng = np.random.default_rng(0)
    q = robot.q_home + rng.uniform(-0.7, 0.7, (batch, robot.n))
    qd = rng.normal(size=(batch, robot.n))
    action = rng.uniform(-1.0, 1.0, (batch, rmp.ACTION_SIZE))
    centers = rng.uniform([0.2, -0.4, 0.0], [0.6, 0.4, 0.5], (5, 3))
    return [jnp.asarray(x, jnp.float32) for x in (q, qd, action)], centers


def torques(ctrl: rmp.RMPVICES, centers):
    """The batched controller from states and policy actions."""
    obstacles = rmp.Obstacles.empty(spheres=5, planes=1).with_spheres(centers, 0.05)
    obstacles = obstacles.with_planes([[0.0, 0.0, TABLE_HEIGHT]], [[0.0, 0.0, 1.0]])

    def act(q, qd, action):
        setpoint = ctrl.setpoint(q, ctrl.decode(action), 0.0)
        return ctrl(q, qd, setpoint, obstacles).tau

    return jax.vmap(act)


def correctness(robot: rmp.Robot) -> list[Row]:
    """Float32 torques on this device against float64 on the host's CPU."""
    states, centers = scene(robot, 1000)
    ctrl = rmp.RMPVICES(robot)
    tau = np.asarray(jax.jit(torques(ctrl, centers))(*states))
    with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
        double = [jnp.asarray(np.asarray(x), jnp.float64) for x in states]
        exact = np.asarray(jax.jit(torques(ctrl, centers))(*double))
    error = np.abs(tau - exact).max(axis=1) / np.abs(exact).max(axis=1)
    note = "largest joint error over the largest torque, 1,000 states, 5 spheres"
    return [
        Row("torque_error_median", float(np.median(error)), "-", note),
        Row("torque_error_p99", float(np.percentile(error, 99)), "-", note),
    ]


def controller(programs: Programs, batches: Sequence[int]) -> Part:
    """Errors of the torques, then evaluations of the tree per second."""
    robot = rmp.Robot.load("jaco2")
    ctrl, scenes = rmp.RMPVICES(robot), [scene(robot, batch) for batch in batches]
    begun = [programs.add(torques(ctrl, centers), *x) for x, centers in scenes]
    compiled = [program.result()[0] for program in begun]

    def measured() -> list[Row]:
        rows = correctness(robot)
        for batch, (x, _), program in zip(batches, scenes, compiled, strict=True):
            timing = Timing(0.0, time_calls(program, *x, seconds=2.0))
            note = f"{len(robot.points.segment)} points, 5 spheres; "
            note += f"{kernels(program)} kernels; {timing.spread}"
            rate = batch / timing.median
            rows.append(Row(f"controller_evals_per_s_{batch}", rate, "1/s", note))
        return rows

    return measured


def kernels(compiled: Any) -> int:
    """Fusions and other calls in a program, each a kernel on a GPU."""
    text = compiled.as_text()
    return sum(text.count(f" {name}(") for name in ("fusion", "custom-call"))


def environment(
    programs: Programs, physics: str, name: str, batches: Sequence[int]
) -> Part:
    """Policy steps per second under random actions."""
    env = envs.load("trajectory", controller=name, physics=physics)
    reset = jax.vmap(env.reset)
    keys = jax.random.split(jax.random.key(0), max(batches))
    actions = jax.random.uniform(
        jax.random.key(1), (len(keys), env.action_size), minval=-1.0
    )
    every = programs.add(reset, keys).result()[0](keys), actions
    inputs = {n: jax.tree.map(lambda x, n=n: x[:n], every) for n in batches}
    begun = [programs.add(jax.vmap(env.step), *x) for x in inputs.values()]
    compiled = [program.result() for program in begun]
    for (step, _), x in zip(compiled, inputs.values(), strict=True):
        jax.block_until_ready(step(*x))  # Warp compiles its kernels here

    def measured() -> list[Row]:
        rows = []
        for (step, compile_s), (n, x) in zip(compiled, inputs.items(), strict=True):
            timing = Timing(compile_s, time_calls(step, *x, seconds=3.0))
            note = f"{env.n_substeps} substeps; compiled in {compile_s:.0f} s beside "
            note += f"all others; {timing.spread}"
            key = f"env_steps_per_s_{physics}_{name}_{n}"
            rows.append(Row(key, n / timing.median, "1/s", note))
        return rows

    return measured


def iterate(
    step: Callable[[Any], Any], state: Any, count: int
) -> tuple[Any, list[Any], list[float]]:
    """Iterate PPO: the last state, the statistics and the seconds of each iteration."""
    stats, times = [], []
    for _ in range(count):
        begin = time.perf_counter()
        state, found, _ = jax.block_until_ready(step(state))
        times.append(time.perf_counter() - begin)
        stats.append(found)
    return state, stats, times


def training(
    programs: Programs, physics: str, num_envs: int, steps: int, episodes: int
) -> Part:
    """Train RMP-VICES on trajectory following, and evaluate the policy if wanted."""
    config = PPOConfig(num_envs=num_envs, num_minibatches=16)
    iterations = -(-steps // config.steps_per_iteration)
    env = envs.load("trajectory", controller="rmp_vices", physics=physics)
    ppo, key = make_ppo(env, config), jax.random.key(0)

    nothing = evaluate.Taped(0, 0)

    def play(state, key):
        parameters = state.normalizer, state.learner.policy
        agent = make_agent(ppo.networks, *parameters, deterministic=True)
        return evaluate.play(env, episodes, nothing, agent, key)[0]

    start = programs.add(ppo.init, key).result()[0](key)
    trainer = programs.add(ppo.iterate, start)
    judge = programs.add(play, start, key) if episodes else None
    step, compile_s = trainer.result()
    jax.block_until_ready(step(start))  # Warp compiles its kernels here

    def measured() -> list[Row]:
        state, stats, times = iterate(step, start, iterations)
        sums = [found.step_sums for found in stats]
        events = sum(float(one["collision"] + one["joint_limit"]) for one in sums)
        rate = config.steps_per_iteration / float(np.median(times))
        taken = f"{iterations * config.steps_per_iteration:,} policy steps"
        note = f"{num_envs:,} environments, seed 0"
        rows = [
            ("steps_per_s", rate, "1/s", f"updates included; {note}"),
            ("compile_s", compile_s, "s", f"beside all others; {note}"),
            ("train_s", sum(times), "s", f"{taken}; {note}"),
            ("events", events, "-", f"collisions and joint limits, {taken}; {note}"),
        ]
        if judge:
            results = jax.device_get(judge.result()[0](state, jax.random.key(1)))
            summary = evaluate.summarise(results, env.metrics)
            judged = f"{episodes:,} episodes; {note}"
            rows += [
                (f"eval_{name}_rate", summary[f"{name}_rate"], "-", judged)
                for name in ("success", "collision", "joint_limit")
            ]
        return [Row(f"ppo_{key}_{physics}_{num_envs}", *rest) for key, *rest in rows]

    return measured


def cell(programs: Programs, physics: str, preset: Preset, own: Cell) -> Part:
    """All seeds of a cell of the paper's grid in one program, for some iterations."""
    config = preset.config(own).replace(physics=physics, num_seeds=preset.seeds)
    env = cells.load(config)
    ppo, keys = make_ppo(env, config.ppo), seeds.keys(config.ppo)
    start = programs.add(jax.vmap(ppo.init), keys).result()[0](keys)
    step, compile_s = programs.add(jax.vmap(ppo.iterate), start).result()
    jax.block_until_ready(step(start))  # Warp compiles its kernels here

    def measured() -> list[Row]:
        count = min(ITERATIONS, config.num_iterations)
        *_, times = iterate(step, start, count)
        seconds = float(np.median(times))
        rate = config.ppo.num_seeds * config.ppo.steps_per_iteration / seconds
        note = f"{config.ppo.num_seeds} seeds of {config.ppo.num_envs} environments; "
        note += (
            f"median of {len(times)} iterations, {min(times):.3f} to {max(times):.3f} s"
        )
        whole = f"{config.num_iterations} such iterations; "
        rows = [
            ("steps_per_s", rate, "1/s", "updates included; " + note),
            ("compile_s", compile_s, "s", "beside all others; " + note),
            ("train_s", seconds * config.num_iterations, "s", whole + note),
        ]
        name = f"{physics}_{own.task}_{own.variant}"
        return [Row(f"grid_{key}_{name}", *rest) for key, *rest in rows]

    return measured


def work(
    part: Callable[[Programs], Part], compiled: Barrier, turn: Lock
) -> list[Row] | str:
    """Compile a part in its own process, wait for the others, measure in turn.

    Returns:
        Its rows, or why it failed.
    """
    runtime.configure(compile_cache=False)
    try:
        try:
            measured = part(Programs())
        finally:
            compiled.wait()
        with turn:
            return measured()
    except Exception:
        return traceback.format_exc()


def engines() -> list[str]:
    """Installed physics engines that run on an accelerator."""
    try:
        sim.require("warp")
    except sim.PhysicsError:
        return ["mjx"]
    return ["mjx", "warp"]


def grid(small: bool) -> dict[str, Callable[[Programs], Part]]:
    """The cells of the paper's grid by name."""
    preset = PRESETS["smoke" if small else "full"]
    return {
        f"{engine}, {own}": partial(cell, physics=engine, preset=preset, own=own)
        for engine in engines()
        for own in preset.cells()
        if own.seed == 0
    }


def sweep(small: bool) -> dict[str, Callable[[Programs], Part]]:
    """The parts by name."""
    evaluations = [256] if small else [1, 2048, 8192, 32768]
    sizes = [32, 64] if small else [2048, 8192, 32768]
    *_, middle, most = sizes
    steps, episodes = (2048, 100) if small else (8_000_000, 1000)
    parts: dict[str, Callable[[Programs], Part]] = {
        "controller": partial(controller, batches=evaluations)
    }
    for engine in engines():
        for name, batches in (("rmp_vices", sizes), ("vices", [middle])):
            parts[f"{engine}, {name}"] = partial(
                environment, physics=engine, name=name, batches=batches
            )
        for num_envs, taken, judged in (
            (middle, steps, episodes),
            (most, steps // 4, 0),
        ):
            parts[f"{engine}, training, {num_envs:,} environments"] = partial(
                training,
                physics=engine,
                num_envs=num_envs,
                steps=taken,
                episodes=judged,
            )
    return parts


def main(args: Sequence[str] | None = None) -> None:
    """Run the sweep, writing after every part; exit code 1 if a part failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--quick", action="store_true", help="small sizes")
    parser.add_argument(
        "--grid", action="store_true", help="instead, the paper's grid, ten seeds each"
    )
    options = parser.parse_args(args)
    begin = time.perf_counter()
    # One process must not take the memory of the others.
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    parts = (grid if options.grid else sweep)(options.quick)
    context = multiprocessing.get_context("spawn")
    rows: list[Row] = []
    failed = 0
    with context.Manager() as shared, ProcessPoolExecutor(len(parts), context) as pool:
        barrier, turn = shared.Barrier(len(parts)), shared.Lock()
        begun = {pool.submit(work, parts[k], barrier, turn): k for k in parts}
        for done in as_completed(begun):
            found = done.result()
            if isinstance(found, str):
                failed += 1
                print(f"{begun[done]} failed:\n{found}", file=sys.stderr)
                continue
            rows += found
            taken = Row("sweep_s", time.perf_counter() - begin, "s", "up to here")
            write_json(options.json, [*rows, taken], quick=options.quick)
    show(rows, "accelerator sweep")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
