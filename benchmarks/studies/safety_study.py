"""Drive many arms with fixed policies and record every step of every one."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import envs
from benchmarks.studies.policies import POLICIES, Policies, View, trained
from envs.base import ArmEnv
from envs.spheres import AWAY
from envs.types import State
from rmp_mjx import RMPVICES
from rmp_mjx.control.controller import Controller, ImpedanceController
from rmp_mjx.pytree import Pytree
from rmp_mjx.training.learning.networks import Agent
from rmp_mjx.vec import xyz

EVENTS = (
    "collision",
    "arm_collision",
    "self_collision",
    "joint_limit",
    "turn_limit",
    "joint_velocity",
)
"""Events that are reported."""

SPHERES, RADIUS = 2, 0.05

PARTS = (
    "leaves",
    "contact",
    "braking_share",
    "obstacle_relaxation",
    "limit_relaxation",
    "dither",
    "attractor_weight",
    "regularizer",
)
"""Parts of the controller that a study may replace without compiling again."""


class Group(NamedTuple):
    """Worlds of a batch that share a policy and a scene."""

    policy: str
    """A name in `POLICIES`, or `trained`."""
    worlds: int
    """Number of worlds."""
    layout: str | None = "close"
    """Layout of the spheres; None for no spheres."""
    limit: int = 1024
    """Policy steps after which an episode ends."""
    spheres: int | None = None
    """Number of spheres; None: all of the scene."""
    speed: float | None = None
    """Their speed [m/s]; None: the environment's."""
    noise: float | None = None
    """Noise of the sphere positions that the controller sees [m]; None likewise."""
    delay: float | None = None
    """Delay of these positions [s]; None likewise."""
    torque: float = 1.0
    """Share of the arm's torque limits that the controller may use."""


class World(Pytree):
    """One environment, its policy's memory, and its group's settings."""

    state: State
    """Environment."""
    memory: Array
    """The policy's memory."""
    special: dict[str, Array]
    """Its group's `spheres`, `speed`, `noise`, `delay` and `torque`."""


class Study:
    """A compiled experiment: the same worlds, policies and seeds for any leaves."""

    def __init__(
        self,
        controller: Controller | str,
        groups: Sequence[Group],
        steps: int,
        *,
        task: str = "trajectory",
        agent: Agent | None = None,
        restart: bool = True,
        **options: Any,
    ):
        """Build the scene.

        Args:
            controller: Kind of controller; `run` may replace its `PARTS`.
            groups: The worlds.
            steps: Policy steps of each.
            task: A name in `envs.names()`.
            agent: The policy `trained`.
            restart: Whether a world whose episode is over begins another one.
            **options: The task's; two spheres unless it says otherwise.
        """
        self.groups, self.steps, self.restart = tuple(groups), steps, restart
        self.policies: Policies = POLICIES
        if agent is not None:
            self.policies = POLICIES | {"trained": lambda: trained(agent)}
        speed = max(group.speed or 0.0 for group in self.groups)
        options = {"obstacle_speed": speed} | options
        options = {"obstacles": SPHERES, "sphere_radius": RADIUS} | options
        self.env = envs.load(task, controller=controller, **options)
        self._run = jax.jit(self._simulate)

    def run(
        self, controller: Controller, seed: int
    ) -> dict[Group, dict[str, np.ndarray]]:
        """Every step's figures by group, (steps, worlds) each."""
        figures = self._run(parts_of(controller), jax.random.key(seed))
        figures = jax.tree.map(np.asarray, figures)
        ends = np.cumsum([g.worlds for g in self.groups])[:-1]
        split = {k: np.split(v, ends, axis=1) for k, v in figures.items()}
        return {
            group: {k: v[i] for k, v in split.items()}
            for i, group in enumerate(self.groups)
        }

    def _simulate(self, parts: dict[str, Any], key: Array) -> dict[str, Array]:
        env = with_parts(self.env, parts)
        names = tuple(self.policies)
        policy = jnp.array(self._each(lambda g: names.index(g.policy)))
        limit = self._each(lambda g: g.limit)

        def one(worlds: World, key: Array) -> tuple[World, dict[str, Array]]:
            key_act, key_reset = jax.random.split(key)
            keys = jax.random.split(key_act, len(policy))
            worlds, figures = jax.vmap(
                lambda world, key, policy: advance(
                    env, world, key, policy, self.policies
                )
            )(worlds, keys, policy)
            over = (worlds.state.done > 0) | (worlds.state.info["step"] >= limit)
            figures |= {"over": over, "age": worlds.state.info["step"]}
            if not self.restart:
                return worlds, figures
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
        split = lambda i, g: jax.random.split(jax.random.fold_in(key, i), g.worlds)  # noqa: E731
        keys = jnp.concatenate([split(i, g) for i, g in enumerate(self.groups)])
        special = self._special()
        layouts = self._each(lambda g: g.layout or self.env.options.layout)
        parts, order = [], []
        for layout in np.unique(layouts):  # one reset in the program for each
            env = copy.copy(self.env)
            env.options = dataclasses.replace(env.options, layout=str(layout))
            chosen = np.flatnonzero(layouts == layout)
            parts.append(
                jax.vmap(lambda k, v, env=env: _traced(env, obstacle_speed=v).reset(k))(
                    keys[chosen], special["speed"][chosen]
                )
            )
            order.append(chosen)
        back = np.argsort(np.concatenate(order))
        state = jax.tree.map(lambda *x: jnp.concatenate(x)[back], *parts)
        state = jax.vmap(_with_spheres)(state, special["spheres"])
        keys = jax.random.fold_in(key, len(self.groups))
        keys = jax.random.split(keys, len(policy))

        def memory(key: Array, policy: Array) -> Array:
            starts = [make().start(key) for make in self.policies.values()]
            return jnp.stack(starts)[policy]

        return World(state, jax.vmap(memory)(keys, policy), special)

    def _special(self) -> dict[str, Array]:
        """The settings of each world, (worlds,) each."""
        env, options = self.env, self.env.options
        special = {
            "spheres": lambda g: _or(g.spheres, env.scene.spheres) if g.layout else 0,
            "speed": lambda g: _or(g.speed, options.obstacle_speed),
            "noise": lambda g: _or(g.noise, options.obstacle_noise),
            "delay": lambda g: _or(g.delay, options.obstacle_delay),
            "torque": lambda g: g.torque,
        }
        return {name: jnp.array(self._each(value)) for name, value in special.items()}

    def _each(self, value: Callable[[Group], Any]) -> np.ndarray:
        """A value of each world's group, (worlds,)."""
        count = [group.worlds for group in self.groups]
        return np.repeat([value(group) for group in self.groups], count)


def parts_of(controller: Any) -> dict[str, Any]:
    """The `PARTS` of RMP-VICES; empty for another controller."""
    if not isinstance(controller, RMPVICES):
        return {}
    return {name: getattr(controller, name) for name in PARTS}


def with_parts(env: ArmEnv, parts: dict[str, Any]) -> ArmEnv:
    """The environment with these parts of its controller."""
    env = copy.copy(env)
    assert isinstance(env.controller, ImpedanceController)
    env.controller = env.controller.replace(**parts)
    return env


def _or(value: Any, default: Any) -> Any:
    return default if value is None else value


def _with_spheres(state: State, count: Array) -> State:
    """The same world with all spheres but the first `count` moved away."""
    spheres, centers = state.info["spheres"], state.data.mocap_pos
    kept = jnp.arange(len(centers)) < count
    spheres = spheres.replace(
        placed=spheres.placed & kept,
        velocity=jnp.where(kept[:, None], spheres.velocity, 0.0),
    )
    centers = jnp.where(kept[:, None], centers, jnp.array(AWAY))
    return state.replace(
        data=state.data.replace(mocap_pos=centers),
        info=state.info | {"spheres": spheres},
    )


def _traced(env: ArmEnv, **values: Array) -> ArmEnv:
    """The environment with traced options, without their validation."""
    env, options = copy.copy(env), copy.copy(env.options)
    for name, value in values.items():
        object.__setattr__(options, name, value)
    env.options = options
    return env


def under(env: ArmEnv, special: dict[str, Array]) -> ArmEnv:
    """The environment with a world's noise, delay and torque limits."""
    env = _traced(env, obstacle_noise=special["noise"], obstacle_delay=special["delay"])
    assert isinstance(env.controller, ImpedanceController)
    robot = env.controller.robot
    robot = robot.replace(tau_max=special["torque"] * robot.tau_max)
    env.controller = env.controller.replace(robot=robot)
    return env


def _pick(mask: Array, new: Any, old: Any) -> Any:
    def pick(n: Array, o: Array) -> Array:
        chosen = jnp.where(mask.reshape(mask.shape + (1,) * (o.ndim - 1)), n, o)
        return chosen.astype(o.dtype)

    return jax.tree.map(pick, new, old)


def to_target(env: ArmEnv, state: State) -> Array:
    """Vector from the grip to its via point; zero in tasks without one."""
    if "points" not in state.task:
        return jnp.zeros(3)
    points, reached = state.task["points"], state.task["reached"]
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


def advance(
    env: ArmEnv,
    world: World,
    key: Array,
    policy: Array,
    policies: Policies = POLICIES,
) -> tuple[World, dict[str, Array]]:
    """One policy step: the world, and the step's figures."""
    state, env = world.state, under(env, world.special)
    site = env.site(state.data)
    view = View(to_target(env, state), _to_obstacle(env, state), state.obs)
    acts = [make().act(world.memory, key, view) for make in policies.values()]
    memory, action = (jnp.stack(column)[policy] for column in zip(*acts, strict=True))
    after = env.step(state, action)
    commanded = env.controller.decode(action).dpos
    moved = env.site(after.data).p - site.p
    figures = {
        "commanded": commanded @ commanded,
        "moved": moved @ commanded,
        "speed": jnp.linalg.norm(moved) / env.dt,
        "turns": jnp.sum(state.data.qvel * after.data.qvel < 0),
    }
    good = after.metrics["nonfinite"] == 0
    figures = {k: jnp.where(good, v, 0.0) for k, v in figures.items()}
    return World(after, memory, world.special), figures | after.metrics
