"""Hours of hostile actions in every task: does anything grow, stop, or turn to NaN?

Run as ``python -m benchmarks.soak --minutes 15 --json FILE``; exit code 1 if a state
was not finite. Every entry of an action is -1 or 1 by chance, among moving spheres.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import envs
from benchmarks.common import Row, show, write_json
from rmp_mjx import runtime
from rmp_mjx.training.learning import rollout

SCENE = {"obstacles": 4, "obstacle_speed": 0.2, "layout": "close", "physics": "mujoco"}
"""Spheres in every task, and the engine."""

LENGTH = 20
"""Policy steps of a turn; the tasks take turns."""


class Soak:
    """A batch of one task under hostile actions, and what has come of it."""

    def __init__(self, task: str, batch: int, seed: int):
        """Reset the environments and take a first turn, which compiles it."""
        env = envs.load(task, controller="rmp_vices", **SCENE)
        self.steps = self.nonfinite = self.events = 0
        self._batch, self._key = batch, jax.random.key(seed)

        def corners(obs, keys):
            def draw(key):
                return jax.random.rademacher(key, (env.action_size,), obs.dtype)

            action = jax.vmap(draw)(keys)
            extras = {"raw_action": action, "log_prob": jnp.zeros(batch)}
            return action, extras

        @jax.jit
        def turn(state, keys):
            state, _, stats = rollout.unroll(env, corners, state, keys, LENGTH)
            return state, rollout.total(stats)

        start = jax.jit(lambda keys: rollout.init(env, keys, staggered=True))
        self._state, self._turn = start(jax.random.split(self._key, batch)), turn
        self.turn()

    def turn(self) -> None:
        """Some policy steps of every environment."""
        self._key, key = jax.random.split(self._key)
        keys = jax.random.split(key, self._batch)
        self._state, stats = self._turn(self._state, keys)
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


def rows_of(tasks: dict[str, Soak], times: list[float], used: np.ndarray) -> list[Row]:
    """Steps and faults by task; memory, descriptors and threads over time.

    Args:
        tasks: The tasks.
        times: When the use was measured [min].
        used: `usage` at these times, (k, 3).
    """
    rows = []
    for name, soak in tasks.items():
        note = f"{soak.steps} policy steps, {soak.events} events"
        rows.append(Row(f"nonfinite_{name}", soak.nonfinite, "steps", note))
    late = len(times) // 2
    slope = np.polyfit(times[late:], used[late:, 0], 1)[0]
    note = f"in minutes {times[late]:.0f} to {times[-1]:.0f}"
    memory = f"{used[late, 0]:.0f} MiB halfway, {used[-1, 0]:.0f} at the end"
    return [
        *rows,
        Row("minutes", times[-1], "min", f"{len(times)} rounds of all tasks"),
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
    args = parser.parse_args()
    runtime.configure()
    tasks = {name: Soak(name, args.envs, args.seed) for name in envs.names()}
    start, times, used = time.monotonic(), [], []
    while not times or times[-1] < args.minutes:
        for soak in tasks.values():
            soak.turn()
        times.append((time.monotonic() - start) / 60.0)
        used.append(usage())
    rows = rows_of(tasks, times, np.array(used))
    show(rows, "Soak")
    if args.json:
        write_json(args.json, rows, envs=args.envs, seed=args.seed, scene=SCENE)
    sys.exit(any(soak.nonfinite for soak in tasks.values()))


if __name__ == "__main__":
    main()
