"""Drive many arms with fixed policies and record every step's safety and torques."""

from __future__ import annotations

import copy
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

import envs
from benchmarks.policies import POLICIES
from envs.base import ArmEnv
from envs.placement import place_spheres, sample_apart
from envs.safety import SafetyRecord, observe
from envs.trajectory import BOX_HIGH, BOX_LOW
from rmp_mjx import RMPVICES, VICES, Obstacles, Setpoint
from rmp_mjx.robot.kinematics import base_point, forward_kinematics, site_pose
from rmp_mjx.sim import PhysicsState

EVENTS = ("collision", "arm_collision", "self_collision", "joint_limit", "turn_limit")
"""Events that are counted when they begin."""

ENDING = ("collision", "self_collision", "joint_limit")
"""Events that end an episode."""

LAYOUTS = ("box", "far", "close")
"""Where spheres may be: anywhere in the box but 3 cm clear of the arm, or as the
trajectory task places them around its via points, the first of which is the target."""

SPHERES, RADIUS = 2, 0.05
REACH = 0.05
"""A target counts as reached within this distance, as in the trajectory task [m]."""

REVERSAL = 1.0
"""A torque that turns round by more than this both ways counts as a reversal [N m]."""

PARTS = ("collision", "self_collision", "joint_limit", "posture", "regularizer")
"""Parts of the controller that a study may replace without compiling again."""


class Group(NamedTuple):
    """Worlds of a batch that share a policy and a scene."""

    policy: str
    """A name in `POLICIES`."""
    layout: str | None
    """One of `LAYOUTS`; None for no spheres."""
    worlds: int
    """How many."""
    limit: int
    """Policy steps after which an episode ends."""
    reaching: bool = False
    """Whether an episode also ends when the target is reached."""


@struct.dataclass
class World:
    """One arm, its obstacles and its policy's memory."""

    data: PhysicsState
    """Physics."""
    placed: Array
    """Spheres that found a place, (k,) bool."""
    target: Array
    """Target of the end effector, (3,) [m]."""
    memory: Array
    """The policy's memory."""
    going_on: dict[str, Array]
    """Events that the last step ended in: they are not counted again."""
    age: Array
    """Policy steps since the reset."""


@struct.dataclass
class Rules:
    """A group's rules as numbers, so that all groups run in one program."""

    policy: Array
    """Index into `POLICIES`."""
    layout: Array
    """Index into `LAYOUTS`; -1 for no spheres."""
    limit: Array
    """Time limit in policy steps."""
    reaching: Array
    """Whether reaching the target ends the episode."""

    @staticmethod
    def of(groups: Sequence[Group]) -> Rules:
        """The rules of every world, group after group."""
        count = [g.worlds for g in groups]
        names = tuple(POLICIES)
        layout = [-1 if g.layout is None else LAYOUTS.index(g.layout) for g in groups]
        return Rules(
            policy=jnp.repeat(
                jnp.array([names.index(g.policy) for g in groups]), np.array(count)
            ),
            layout=jnp.repeat(jnp.array(layout), np.array(count)),
            limit=jnp.repeat(jnp.array([g.limit for g in groups]), np.array(count)),
            reaching=jnp.repeat(
                jnp.array([g.reaching for g in groups]), np.array(count)
            ),
        )


class Study:
    """A compiled experiment: the same worlds, policies and seeds for any leaves."""

    def __init__(
        self,
        controller: RMPVICES | VICES,
        groups: Sequence[Group],
        steps: int,
        *,
        physics: str = "mujoco",
        sim_dt: float = 0.005,
        terminate: bool = True,
    ):
        """Build the scene.

        Args:
            controller: Kind of controller; `run` may replace its `PARTS`.
            groups: The worlds.
            steps: Policy steps of each.
            physics: Engine, `mujoco` or `mjx`.
            sim_dt: Physics and control timestep [s].
            terminate: Whether an event ends an episode; a non-finite state always does.
        """
        self.groups, self.steps, self.terminate = tuple(groups), steps, terminate
        self.env = envs.load(
            "trajectory",
            controller=controller,
            physics=physics,
            robot=controller.robot,
            obstacles=SPHERES,
            sphere_radius=RADIUS,
            sim_dt=sim_dt,
        )
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
        rules = Rules.of(self.groups)
        count = rules.policy.shape[0]

        def fresh(key: Array) -> World:
            keys = jax.random.split(key, count)
            return jax.vmap(functools.partial(reset, env))(keys, rules)

        def one(worlds: World, key: Array) -> tuple[World, dict[str, Array]]:
            key_step, key_reset = jax.random.split(key)
            keys = jax.random.split(key_step, count)
            advance = jax.vmap(functools.partial(step, env))
            worlds, ended, figures = advance(worlds, keys, rules)
            over = (worlds.age >= rules.limit) | (figures["nonfinite"] > 0)
            over |= rules.reaching & (figures["error"] < REACH)
            over |= ended & self.terminate
            figures |= {"over": over, "age": worlds.age}
            worlds = jax.lax.cond(
                over.any(),
                lambda w, key: _pick(over, fresh(key), w),
                lambda w, _: w,
                worlds,
                key_reset,
            )
            return worlds, figures

        key_start, key_run = jax.random.split(key)
        return jax.lax.scan(
            one, fresh(key_start), jax.random.split(key_run, self.steps)
        )[1]


def _pick(mask: Array, new: Any, old: Any) -> Any:
    def pick(n: Array, o: Array) -> Array:
        return jnp.where(mask.reshape(mask.shape + (1,) * (o.ndim - 1)), n, o).astype(
            o.dtype
        )

    return jax.tree.map(pick, new, old)


def reset(env: ArmEnv, key: Array, rules: Rules) -> World:
    """A world near the home pose with new spheres and a new target."""
    key_q, key_target, key_spheres, key_policy = jax.random.split(key, 4)
    robot, n = env.robot, env.robot.n
    q = robot.q_home + 0.02 * jax.random.normal(key_q, (n,))
    targets, _ = sample_apart(key_target, 4, BOX_LOW, BOX_HIGH, 0.10)
    p, R = forward_kinematics(robot, q)
    segment = np.array(robot.points.segment)
    offset = jnp.asarray(robot.points.offset, p.dtype)
    arm = p[:, segment].T + jnp.einsum("ijk,kj->ki", R[:, :, segment], offset)
    arm, radii = base_point(robot) + arm, jnp.asarray(robot.points.radius)

    def place(layout: str) -> tuple[Array, Array]:
        task, nowhere = ("close", 1e3) if layout == "box" else (layout, 0.0)
        return place_spheres(
            key_spheres, SPHERES, RADIUS, task, BOX_LOW, BOX_HIGH,
            targets + nowhere, arm, radii,
        )  # fmt: skip

    options = [place(layout) for layout in LAYOUTS]
    centers, placed = (
        jnp.stack(column)[rules.layout] for column in zip(*options, strict=True)
    )
    placed &= rules.layout >= 0
    centers = jnp.where(placed[:, None], centers, jnp.array([0.0, 0.0, -5.0]))
    memories = jnp.stack([make().start(key_policy) for make in POLICIES.values()])
    return World(
        data=env.physics.init(q, jnp.zeros(n), centers),
        placed=placed,
        target=targets[0],
        memory=memories[rules.policy],
        going_on={name: jnp.zeros((), bool) for name in EVENTS},
        age=jnp.zeros((), jnp.int32),
    )


def drive(
    env: ArmEnv, data: PhysicsState, setpoint: Setpoint, obstacles: Obstacles
) -> tuple[PhysicsState, SafetyRecord, dict[str, Array]]:
    """Hold a set-point for one policy step.

    Returns:
        Physics, safety record, and of the torques within the step: the largest jump
        from one physics step to the next [N m] and the number of reversals.
    """
    n = env.robot.n

    def substep(carry, k):
        data, record, tau, change, jump, reversals = carry
        out = env.controller(data.qpos[:n], data.qvel[:n], setpoint, obstacles)
        data = env.physics.step(data, out.tau)
        now = observe(env.scene, env.robot, data, out.diagnostics["torque_scale"])
        delta = jnp.where(k > 0, out.tau - tau, 0.0)
        back = (delta * change < 0) & (jnp.minimum(abs(delta), abs(change)) > REVERSAL)
        jump = jnp.maximum(jump, jnp.max(jnp.abs(delta)))
        reversals = reversals + jnp.any(back)
        record = record.then(now, 1.0 / env.n_substeps)
        return (data, record, out.tau, delta, jump, reversals), None

    zero = jnp.zeros(n)
    start = (data, SafetyRecord.none(), zero, zero, jnp.zeros(()), jnp.zeros(()))
    (data, record, *_, jump, reversals), _ = jax.lax.scan(
        substep, start, jnp.arange(env.n_substeps)
    )
    return data, record, {"jump": jump, "reversals": reversals}


def step(
    env: ArmEnv, world: World, key: Array, rules: Rules
) -> tuple[World, Array, dict[str, Array]]:
    """One policy step.

    Returns:
        The world, whether an event happened in it, and the step's figures.
    """
    n, ctrl = env.robot.n, env.controller
    before, _ = site_pose(env.robot, world.data.qpos[:n])
    acts = [
        make().act(world.memory, key, world.target - before)
        for make in POLICIES.values()
    ]
    memory, action = (
        jnp.stack(column)[rules.policy] for column in zip(*acts, strict=True)
    )
    setpoint = ctrl.setpoint(world.data.qpos[:n], ctrl.decode(action))
    obstacles = env.obstacles(world.data, world.placed)
    data, record, figures = drive(env, world.data, setpoint, obstacles)
    after, _ = site_pose(env.robot, data.qpos[:n])
    bad = ~(jnp.all(jnp.isfinite(data.qpos)) & jnp.all(jnp.abs(data.qvel) < 1e3))
    now = {name: getattr(record, name) for name in EVENTS}
    begun = {name: now[name] & ~world.going_on[name] for name in EVENTS}
    asked, moved = setpoint.p_des - before, after - before
    figures |= {name: value.astype(jnp.float32) for name, value in begun.items()}
    figures |= {
        "asked": asked @ asked,
        "moved": moved @ asked,
        "speed": jnp.linalg.norm(moved) / env.dt,
        "saturation": record.saturation,
        "force": record.force_peak,
    }
    figures = {k: jnp.where(bad, 0.0, v) for k, v in figures.items()}
    figures["error"] = jnp.linalg.norm(world.target - after)
    figures["nonfinite"] = bad.astype(jnp.float32)
    world = world.replace(data=data, memory=memory, going_on=now, age=world.age + 1)
    ended = functools.reduce(jnp.logical_or, (now[name] for name in ENDING))
    return world, ended, figures
