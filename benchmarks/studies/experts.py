"""Scripted experts: every task solved through the action space, by every controller.

`python -m benchmarks.experts --json benchmarks/results/experts.json` runs each expert
from random starts. A policy will not learn what no expert can do.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import envs
from benchmarks.common import Row, show, write_json
from envs import door
from envs.arms import JACO
from envs.base import ArmEnv
from envs.safety import ENDING
from envs.types import State
from rmp_mjx import runtime
from rmp_mjx.control.action import ActionRange
from rmp_mjx.control.controller import ImpedanceController
from rmp_mjx.math import orientation_error

DEFAULT = ("rmp_vices", "vices", "rmp_vices_literal")
"""Controllers that are compared by default."""


class Memory(NamedTuple):
    """Memory of an expert."""

    R: Array
    """Orientation of the hand, kept from the start, (3, 3)."""
    phase: Array
    """Phase of its plan."""


Act = Callable[[Any, State, Memory], tuple[Memory, Array]]
"""(env, state, memory) -> (memory, action in [-1, 1]^12)."""


class Case(NamedTuple):
    """A scene and its expert."""

    task: str
    """A name in `envs.names()`."""
    act: Act
    """Expert."""
    steps: int
    """Policy steps until the time limit."""
    options: dict[str, Any]
    """Options of the task."""

    @property
    def name(self) -> str:
        """Task and its options."""
        return "/".join([self.task, *map(str, self.options.values())])


def start(env: ArmEnv, state: State) -> Memory:
    """Memory at the start of an episode."""
    return Memory(env.site(state.data).R, jnp.zeros((), jnp.int32))


def action_range(env: ArmEnv) -> ActionRange:
    """What -1 and 1 mean to the task's controller."""
    assert isinstance(env.controller, ImpedanceController), "an expert knows its reach"
    return env.controller.action_range


def command(env: ArmEnv, state: State, R: Array, target: Array) -> Array:
    """Move the grip straight to a target as fast as the action range allows.

    The hand keeps the orientation R; all stiffnesses are the greatest.
    """
    site, span = env.site(state.data), action_range(env)
    move = (target - site.p) / span.dpos
    move = move / jnp.maximum(jnp.max(jnp.abs(move)), 1.0)
    turn = jnp.clip(orientation_error(site.R, R) / span.drot, -1.0, 1.0)
    return jnp.concatenate([move, turn, jnp.ones(6)])


def follow(env: ArmEnv, state: State, memory: Memory) -> tuple[Memory, Array]:
    """Trajectory following: straight to the current via point."""
    points, reached = state.task["points"], state.task["reached"]
    target = points[jnp.minimum(reached, len(points) - 1)]
    return memory, command(env, state, memory.R, target)


def pull(env: door.Door, state: State, memory: Memory) -> tuple[Memory, Array]:
    """Door opening: lead the handle by up to a quarter of a radian.

    It leads by twice the remaining angle, so that it pulls hard nearly to the end. A
    force that fades sooner stalls when it falls below the friction of the hinge.
    """
    n = env.robot.n
    angle, rate = state.data.qpos[n], state.data.qvel[n]
    lead = jnp.clip(2.0 * (door.GOAL - angle) - 0.1 * rate, -0.25, 0.25)
    return memory, command(env, state, memory.R, env.grasp_at(angle + lead))


ABOVE, DOWN, PUSH = 0, 1, 2
"""Phases of pushing."""

BEHIND = 0.085
"""Distance from the block's centre at which the hand comes down [m]."""

HEIGHT_OVER, HEIGHT_PUSH = 0.065, 0.005
"""Height of the grip over the block's centre, above it and pushing [m]."""


def push(env: Any, state: State, memory: Memory) -> tuple[Memory, Array]:
    """Block pushing: over the block, down behind it, push; again if it slipped off."""
    p, block = env.site(state.data).p, env.block(state.data)
    way = (state.task["goal"] - block)[:2]
    left = jnp.linalg.norm(way)
    ahead = way / jnp.maximum(left, 1e-6)
    aside = jnp.array([-ahead[1], ahead[0]])
    offset = (p - block)[:2]
    behind, beside = -offset @ ahead, offset @ aside
    low = p[2] < block[2] + HEIGHT_PUSH + 0.03

    there = jnp.linalg.norm(offset + BEHIND * ahead) < 0.015
    lost = (behind < 0.03) | (jnp.abs(beside) > 0.035)
    phase = memory.phase
    phase = jnp.select(
        [(phase == ABOVE) & there, (phase == DOWN) & low, (phase == PUSH) & lost],
        [DOWN, PUSH, ABOVE],
        phase,
    )
    waiting = block[:2] - BEHIND * ahead
    clear = p[2] > block[2] + HEIGHT_OVER - 0.015
    above = jnp.append(jnp.where(clear, waiting, p[:2]), block[2] + HEIGHT_OVER)
    down = jnp.append(waiting, block[2] + HEIGHT_PUSH)
    speed = jnp.clip(left, 0.02, 0.05)
    along = p[:2] + speed * ahead - beside * aside
    home = left < 0.01
    forward = jnp.append(jnp.where(home, p[:2], along), block[2] + HEIGHT_PUSH)
    target = jnp.select([phase == ABOVE, phase == DOWN], [above, down], forward)
    return Memory(memory.R, phase), command(env, state, memory.R, target)


CASES = (
    Case("trajectory", follow, 300, {}),
    Case("door", pull, 240, {"variant": "light"}),
    Case("door", pull, 240, {"variant": "heavy"}),
    Case("door", pull, 240, {"variant": "vices"}),
    Case("push", push, 400, {}),
)


def rollout(
    env: ArmEnv, act: Act, key: Array, episodes: int, steps: int
) -> dict[str, Array]:
    """Metrics of every step of every episode, (steps, episodes) each.

    They include the steps after an episode's end: see `summarise`.
    """

    def episode(key: Array) -> dict[str, Array]:
        state = env.reset(key)

        def step(carry: tuple[State, Memory], _):
            state, memory = carry
            memory, action = act(env, state, memory)
            state = env.step(state, action)
            return (state, memory), state.metrics | {"done": state.done}

        return jax.lax.scan(step, (state, start(env, state)), None, length=steps)[1]

    return jax.vmap(episode, out_axes=1)(jax.random.split(key, episodes))


def play(
    env: ArmEnv, act: Act, episodes: int, steps: int, seed: int
) -> dict[str, np.ndarray]:
    """`rollout`, compiled and run."""
    run = jax.jit(lambda key: rollout(env, act, key, episodes, steps))
    return jax.tree.map(np.asarray, run(jax.random.key(seed)))


def ends(metrics: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Steps of the first success and the first event; the number of steps if none."""
    solved = metrics["success"] > 0
    event = np.any([metrics[e] > 0 for e in ENDING], axis=0)
    return _first(solved), _first(event)


def _first(on: np.ndarray) -> np.ndarray:
    return np.where(on.any(0), on.argmax(0), len(on))


def solved(metrics: dict[str, np.ndarray]) -> float:
    """Share of the episodes that succeeded before any event."""
    first, ended = ends(metrics)
    return float((first < ended).mean())


def summarise(name: str, dt: float, metrics: dict[str, np.ndarray]) -> list[Row]:
    """Success before any event, how long it took, events, forces."""
    steps, episodes = metrics["success"].shape
    first, ended = ends(metrics)
    good = first < ended
    alive = np.arange(steps)[:, None] <= np.minimum(first, ended)
    in_touch = alive & (metrics["work_force"] > 0)
    force = metrics["work_force"][in_touch]
    count = {e: int((metrics[e].astype(bool) & alive).any(0).sum()) for e in ENDING}
    rows = [
        Row(
            f"{name}/success",
            100.0 * float(good.mean()),
            "%",
            f"{episodes} random starts",
        ),
        Row(
            f"{name}/events",
            float((ended < first).sum()),
            "episodes",
            ", ".join(f"{e} {n}" for e, n in count.items()),
        ),
    ]
    if good.any():
        took = float(np.median(first[good] + 1) * dt)
        rows.append(Row(f"{name}/time", took, "s", "median of the solved episodes"))
    if force.size:
        peak = np.where(alive, metrics["work_force_peak"], 0.0).max(0)
        note = f"mean while touching; median episode's peak {np.median(peak):.0f} N"
        rows.append(Row(f"{name}/work_force", float(force.mean()), "N", note))
    return rows


def main(args: Sequence[str] | None = None) -> None:
    """Run every case with every controller."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tasks", nargs="+", default=[c.task for c in CASES])
    parser.add_argument("--controllers", nargs="+", default=DEFAULT)
    parser.add_argument("--robots", nargs="+", default=[JACO])
    parser.add_argument("--json", type=Path, help="benchmarks/results/experts.json")
    options = parser.parse_args(args)
    runtime.configure()
    rows: list[Row] = []
    for case in CASES:
        wanted = options.controllers if case.task in options.tasks else ()
        for robot, controller in itertools.product(options.robots, wanted):
            arm = {"robot": robot, "controller": controller}
            env = envs.load(case.task, **arm, **case.options)
            metrics = play(env, case.act, options.episodes, case.steps, options.seed)
            words = [case.name, controller, *([] if robot == JACO else [robot])]
            new = summarise("/".join(words), env.dt, metrics)
            rows += new
            show(new, ", ".join(words))
    if options.json:
        write_json(options.json, rows, episodes=options.episodes, seed=options.seed)


if __name__ == "__main__":
    main()
