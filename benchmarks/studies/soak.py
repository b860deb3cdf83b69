"""Hours of hostile actions in every task: does anything grow, stop, or turn to NaN?

Three attackers act in each, among moving spheres: one whose actions have -1 or 1 in
every entry, by chance, and two that PPO has trained, to hit something and to reach
joint limits. Run as ``python -m benchmarks.soak --minutes 15 --json FILE``; exit code 1
if a state was not finite.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import envs
from benchmarks.common import Row, show, write_json
from rmp_mjx import runtime
from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.learning import rollout
from rmp_mjx.training.learning.ppo import make_ppo

SCENE = {"obstacles": 4, "obstacle_speed": 0.2, "layout": "close", "physics": "mujoco"}
"""Spheres in every task, and the engine."""

LENGTH = 20
"""Policy steps of a turn; the tasks take turns."""

CHANCE = "chance"
"""The attacker that does not learn."""

Turn = Callable[[Any], tuple[Any, rollout.RolloutStats]]
"""From a carry to the next one, with the statistics between."""


def hits(env: Any, state: Any) -> Array:
    """Pay for nearness to obstacles, and more for touching one."""
    near = jnp.exp(-jnp.maximum(state.metrics["clearance"], 0.0) / 0.02)
    return near + 20.0 * state.metrics["collision"]


def limits(env: Any, state: Any) -> Array:
    """Pay for nearness to a joint's limit, and more for reaching it."""
    robot = env.robot
    q = state.data.qpos[: robot.n]
    room = jnp.min(jnp.minimum(q - robot.q_lower, robot.q_upper - q))
    return jnp.exp(-jnp.maximum(room, 0.0) / 0.05) + 20.0 * state.metrics["joint_limit"]


PAYS: dict[str, Callable[[Any, Any], Array]] = {"hit": hits, "limit": limits}
"""What the trained attackers are paid for."""


class Paid:
    """An environment that pays for something else."""

    def __init__(self, env: Any, pay: Callable[[Any, Any], Array]):
        """Wrap an environment."""
        self.env, self.pay = env, pay

    def __getattr__(self, name: str) -> Any:
        """All but the reward is the environment's own."""
        return getattr(self.env, name)

    def step(self, state: Any, action: Array) -> Any:
        """One policy step with the other reward."""
        state = self.env.step(state, action)
        return state.replace(reward=self.pay(self.env, state))


def by_chance(env: Any, batch: int, seed: int) -> tuple[Any, Turn]:
    """A start and turns whose actions are corners of their box."""

    def corners(obs, keys):
        def draw(key):
            return jax.random.rademacher(key, (env.action_size,), obs.dtype)

        return jax.vmap(draw)(keys), {
            "raw_action": jnp.zeros((batch, env.action_size)),
            "log_prob": jnp.zeros(batch),
        }

    @jax.jit
    def turn(carry):
        state, key = carry
        key, now = jax.random.split(key)
        keys = jax.random.split(now, batch)
        state, _, stats = rollout.unroll(env, corners, state, keys, LENGTH)
        return (state, key), rollout.total(stats)

    start, key = jax.random.split(jax.random.key(seed))
    init = jax.jit(lambda keys: rollout.init(env, keys, staggered=True))
    return (init(jax.random.split(start, batch)), key), turn


def trained(env: Any, batch: int, seed: int, steps: int) -> tuple[Any, Turn]:
    """An attacker after so many policy steps of PPO, and its turns, with its noise."""
    config = PPOConfig(num_envs=batch, unroll_length=LENGTH, seed=seed)
    ppo = make_ppo(env, config)
    state = jax.jit(ppo.init)(jax.random.key(seed))
    gather, learn = jax.jit(ppo.gather), jax.jit(ppo.learn)
    for _ in range(steps // (batch * LENGTH)):
        state, data, _ = gather(state)
        state, _ = learn(state, data)

    def turn(carry):
        carry, _, stats = gather(carry)
        return carry, stats

    return state, turn


class Soak:
    """A batch of one task under one attacker, and what has come of it."""

    def __init__(self, task: str, actor: str, batch: int, seed: int, steps: int):
        """Train the attacker if it is to be, and take a turn, which compiles it."""
        env = envs.load(task, controller="rmp_vices", **SCENE)
        self.steps = self.nonfinite = self.events = 0
        self._batch = batch
        if actor == CHANCE:
            self._carry, self._turn = by_chance(env, batch, seed)
        else:
            paid = Paid(env, PAYS[actor])
            self._carry, self._turn = trained(paid, batch, seed, steps)
        self.turn()

    def turn(self) -> None:
        """Some policy steps of every environment."""
        self._carry, stats = self._turn(self._carry)
        self.steps += LENGTH * self._batch
        self.nonfinite += int(stats.nonfinite)
        self.events += int(
            stats.step_sums["collision"] + stats.step_sums["joint_limit"]
        )


def usage() -> tuple[float, int, int]:
    """Resident memory [MiB], open descriptors and threads of this process."""
    status = Path("/proc/self/status").read_text()
    fields = dict(line.split(":", 1) for line in status.splitlines())
    files = len(list(Path("/proc/self/fd").iterdir()))
    return int(fields["VmRSS"].split()[0]) / 1024.0, files, int(fields["Threads"])


def rows_of(soaks: dict[str, Soak], times: list[float], used: np.ndarray) -> list[Row]:
    """Steps and faults by task and attacker; memory, descriptors and threads over time.

    Args:
        soaks: By task and attacker.
        times: When the use was measured [min].
        used: `usage` at these times, (k, 3).
    """
    rows = []
    for name, soak in soaks.items():
        note = f"{soak.steps} policy steps, {soak.events} events"
        rows.append(Row(f"nonfinite_{name}", soak.nonfinite, "steps", note))
    late = len(times) // 2
    slope = np.polyfit(times[late:], used[late:, 0], 1)[0]
    note = f"in minutes {times[late]:.0f} to {times[-1]:.0f}"
    memory = f"{used[late, 0]:.0f} MiB halfway, {used[-1, 0]:.0f} at the end"
    return [
        *rows,
        Row("minutes", times[-1], "min", f"{len(times)} rounds of all"),
        Row("memory_growth", float(slope), "MiB/min", f"{note}; {memory}"),
        *(
            Row(name, int(np.ptp(used[late:, k])), "difference", f"{note}: {span}")
            for k, name in ((1, "descriptors"), (2, "threads"))
            for span in [f"{used[late:, k].min():.0f} to {used[late:, k].max():.0f}"]
        ),
    ]


def main() -> None:
    """Soak, print, and write the requested file."""
    parser = argparse.ArgumentParser(description="A soak of all tasks.")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--minutes", type=float, default=15.0, help="after compiling")
    parser.add_argument("--envs", type=int, default=64, help="environments of a task")
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    parser.add_argument(
        "--train", type=int, default=40_000, help="policy steps an attacker learns"
    )
    args = parser.parse_args()
    runtime.configure()
    soaks = {
        f"{task}_{actor}": Soak(task, actor, args.envs, args.seed, args.train)
        for task in envs.names()
        for actor in (CHANCE, *PAYS)
    }
    start, times, used = time.monotonic(), [], []
    while not times or times[-1] < args.minutes:
        for soak in soaks.values():
            soak.turn()
        times.append((time.monotonic() - start) / 60.0)
        used.append(usage())
    rows = rows_of(soaks, times, np.array(used))
    show(rows, "Soak")
    if args.json:
        settings = {"envs": args.envs, "seed": args.seed, "train": args.train}
        settings["scene"] = SCENE
        write_json(args.json, rows, **settings)
    sys.exit(any(soak.nonfinite for soak in soaks.values()))


if __name__ == "__main__":
    main()
