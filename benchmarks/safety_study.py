"""Drive many arms with fixed policies and record every step of every one."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

import envs
from benchmarks.policies import POLICIES, View
from envs.base import ArmEnv
from envs.spheres import AWAY
from envs.types import State
from rmp_mjx import RMPVICES, VICES
from rmp_mjx.vec import xyz

EVENTS = ("collision", "arm_collision", "self_collision", "joint_limit", "turn_limit")
"""Events that are reported."""

ENDING = ("collision", "self_collision", "joint_limit")
"""Events that end an episode."""

SPHERES, RADIUS = 2, 0.05

PARTS = (
    "collision",
    "self_collision",
    "joint_limit",
    "posture",
    "yielding",
    "limit_yielding",
    "attractor_weight",
    "regularizer",
)
"""Parts of the controller that a study may replace without compiling again."""


class Group(NamedTuple):
    """Worlds of a batch that share a policy and a scene."""

    policy: str
    """A name in `POLICIES`."""
    worlds: int
    """How many."""
    layout: str | None = "close"
    """Layout of the spheres; None for no spheres."""
    limit: int = 1024
    """Policy steps after which an episode ends."""


@struct.dataclass
class World:
    """One environment and its policy's memory."""

    state: State
    """Environment."""
    memory: Array
    """The policy's memory."""


class Study:
    """A compiled experiment: the same worlds, policies and seeds for any leaves."""

    def __init__(
        self,
        controller: RMPVICES | VICES | str,
        groups: Sequence[Group],
        steps: int,
        *,
        task: str = "trajectory",
        **options: Any,
    ):
        """Build the scene.

        Args:
            controller: Kind of controller; `run` may replace its `PARTS`.
            groups: The worlds.
            steps: Policy steps of each.
            task: A name in `envs.names()`.
            **options: The task's; two spheres unless it says otherwise.
        """
        self.groups, self.steps = tuple(groups), steps
        options = {"obstacles": SPHERES, "sphere_radius": RADIUS} | options
        self.env = envs.load(task, controller=controller, **options)
        self._run = jax.jit(self._simulate)

    def run(
        self, controller: RMPVICES | VICES, seed: int
    ) -> dict[Group, dict[str, np.ndarray]]:
        """Every step's figures by group, (steps, worlds) each."""
        parts = {}
        if isinstance(controller, RMPVICES):
            parts = {name: getattr(controller, name) for name in PARTS}
        figures = jax.tree.map(np.asarray, self._run(parts, jax.random.key(seed)))
        ends = np.cumsum([g.worlds for g in self.groups])[:-1]
        split = {k: np.split(v, ends, axis=1) for k, v in figures.items()}
        return {
            group: {k: v[i] for k, v in split.items()}
            for i, group in enumerate(self.groups)
        }

    def _simulate(self, parts: dict[str, Any], key: Array) -> dict[str, Array]:
        env = copy.copy(self.env)
        env.controller = env.controller.replace(**parts)
        count = np.array([g.worlds for g in self.groups])
        each = lambda values: np.repeat(np.array(values), count)  # noqa: E731
        names = tuple(POLICIES)
        policy = jnp.array(each([names.index(g.policy) for g in self.groups]))
        limit = each([g.limit for g in self.groups])

        def one(worlds: World, key: Array) -> tuple[World, dict[str, Array]]:
            key_act, key_reset = jax.random.split(key)
            keys = jax.random.split(key_act, len(policy))
            worlds, figures = jax.vmap(lambda *x: _advance(env, *x))(
                worlds, keys, policy
            )
            over = (worlds.state.done > 0) | (worlds.state.info["step"] >= limit)
            figures |= {"over": over, "age": worlds.state.info["step"]}
            worlds = jax.lax.cond(
                over.any(),
                lambda w, key: _pick(over, self._fresh(key, policy), w),
                lambda w, _: w,
                worlds,
                key_reset,
            )
            return worlds, figures

        key_start, key_run = jax.random.split(key)
        start = self._fresh(key_start, policy)
        return jax.lax.scan(one, start, jax.random.split(key_run, self.steps))[1]

    def _fresh(self, key: Array, policy: Array) -> World:
        """Worlds at the start of an episode, each in its group's layout."""
        parts = []
        for i, group in enumerate(self.groups):
            env = copy.copy(self.env)
            layout = group.layout or self.env.options.layout
            env.options = dataclasses.replace(env.options, layout=layout)
            keys = jax.random.split(jax.random.fold_in(key, i), group.worlds)
            state = jax.vmap(env.reset)(keys)
            parts.append(state if group.layout else _without_spheres(state))
        state = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
        keys = jax.random.split(jax.random.fold_in(key, len(parts)), len(policy))

        def memory(key: Array, policy: Array) -> Array:
            starts = [make().start(key) for make in POLICIES.values()]
            return jnp.stack(starts)[policy]

        return World(state, jax.vmap(memory)(keys, policy))


def _without_spheres(state: State) -> State:
    """The same worlds, their spheres out of the way."""
    spheres = state.info["spheres"]
    spheres = spheres.replace(
        placed=jnp.zeros_like(spheres.placed), velocity=0.0 * spheres.velocity
    )
    away = jnp.broadcast_to(jnp.array(AWAY), state.data.mocap_pos.shape)
    return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
        data=state.data.replace(mocap_pos=away),  # pyright: ignore[reportAttributeAccessIssue]
        info=state.info | {"spheres": spheres},
    )


def _pick(mask: Array, new: Any, old: Any) -> Any:
    def pick(n: Array, o: Array) -> Array:
        chosen = jnp.where(mask.reshape(mask.shape + (1,) * (o.ndim - 1)), n, o)
        return chosen.astype(o.dtype)

    return jax.tree.map(pick, new, old)


def _to_target(env: ArmEnv, state: State) -> Array:
    """From the grip to the via point it is to reach; zero in tasks without one."""
    if "points" not in state.info:
        return jnp.zeros(3)
    points, reached = state.info["points"], state.info["reached"]
    return points[jnp.minimum(reached, len(points) - 1)] - env.site(state.data).p


def _to_obstacle(env: ArmEnv, state: State) -> Array:
    """Unit vector from the arm's point with the least clearance to the obstacle."""
    least, direction = jnp.inf, jnp.zeros(3)
    for gap in env.gaps(state.data, state.info["spheres"]):
        distance = jnp.where(gap.active, gap.distance, jnp.inf).reshape(-1)
        normal = gap.normal.map(lambda c, d=gap.distance: jnp.broadcast_to(c, d.shape))
        nearest = jnp.argmin(distance)
        toward = -jnp.stack([c.reshape(-1)[nearest] for c in xyz(normal)])
        closer = distance[nearest] < least
        direction = jnp.where(closer, toward, direction)
        least = jnp.minimum(least, distance[nearest])
    return direction


def _advance(
    env: ArmEnv, world: World, key: Array, policy: Array
) -> tuple[World, dict[str, Array]]:
    """One policy step: the world, and the step's figures."""
    state = world.state
    site = env.site(state.data)
    view = View(_to_target(env, state), _to_obstacle(env, state))
    acts = [make().act(world.memory, key, view) for make in POLICIES.values()]
    memory, action = (jnp.stack(column)[policy] for column in zip(*acts, strict=True))
    after = env.step(state, action)
    asked = env.controller.decode(action).dpos
    moved = env.site(after.data).p - site.p
    figures = {
        "asked": asked @ asked,
        "moved": moved @ asked,
        "speed": jnp.linalg.norm(moved) / env.dt,
        "turns": jnp.sum(state.data.qvel * after.data.qvel < 0),
    }
    good = after.metrics["nonfinite"] == 0
    figures = {k: jnp.where(good, v, 0.0) for k, v in figures.items()}
    return World(after, memory), figures | after.metrics
