"""Drive many arms with a policy and record every step's safety and torques."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

import envs
from benchmarks.policies import Policy
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
trajectory task places them around its via points (here: around the target)."""

REVERSAL = 1.0
"""A torque that turns round by more than this both ways counts as a reversal [N m]."""

NOWHERE = 1e3
"""Distance of a target that constrains no sphere [m]."""


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


def make_env(
    controller: RMPVICES | VICES, physics: str, spheres: int, sim_dt: float
) -> ArmEnv:
    """The trajectory task's scene with a controller in it."""
    return envs.load(
        "trajectory",
        controller=controller,
        physics=physics,
        robot=controller.robot,
        obstacles=spheres,
        sim_dt=sim_dt,
    )


def reset(env: ArmEnv, policy: Policy, layout: str, key: Array) -> World:
    """A world near the home pose with new spheres and a new target."""
    key_q, key_target, key_spheres, key_policy = jax.random.split(key, 4)
    robot, n = env.robot, env.robot.n
    q = robot.q_home + 0.02 * jax.random.normal(key_q, (n,))
    targets, _ = sample_apart(key_target, 4, BOX_LOW, BOX_HIGH, 0.10)
    p, R = forward_kinematics(robot, q)
    segment = np.array(robot.points.segment)
    offset = jnp.asarray(robot.points.offset, p.dtype)
    arm = p[:, segment].T + jnp.einsum("ijk,kj->ki", R[:, :, segment], offset)
    centers, placed = place_spheres(
        key_spheres,
        env.scene.spheres,
        0.05,
        "close" if layout == "box" else layout,
        BOX_LOW,
        BOX_HIGH,
        targets + NOWHERE if layout == "box" else targets,
        base_point(robot) + arm,
        jnp.asarray(robot.points.radius),
    )
    centers = jnp.where(placed[:, None], centers, jnp.array([0.0, 0.0, -5.0]))
    return World(
        data=env.physics.init(q, jnp.zeros(n), centers),
        placed=placed,
        target=targets[0],
        memory=policy.start(key_policy),
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
    env: ArmEnv, policy: Policy, world: World, key: Array
) -> tuple[World, Array, dict[str, Array]]:
    """One policy step.

    Returns:
        The world, whether an event happened in it, and the step's figures.
    """
    n, ctrl = env.robot.n, env.controller
    before, _ = site_pose(env.robot, world.data.qpos[:n])
    memory, action = policy.act(world.memory, key, world.target - before)
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
        "error": jnp.linalg.norm(world.target - after),
    }
    figures = {k: jnp.where(bad, 0.0, v) for k, v in figures.items()}
    figures["nonfinite"] = bad.astype(jnp.float32)
    world = world.replace(data=data, memory=memory, going_on=now, age=world.age + 1)
    ended = functools.reduce(jnp.logical_or, (now[name] for name in ENDING))
    return world, ended | bad, figures


def record(
    env: ArmEnv,
    policy: Policy,
    layout: str,
    seed: int,
    num_envs: int,
    steps: int,
    *,
    terminate: bool = True,
    episode_length: int = 1024,
) -> dict[str, np.ndarray]:
    """Every step's figures of a batch of worlds, (steps, num_envs) each.

    Args:
        env: Scene and controller.
        policy: What moves the set-point.
        layout: One of `LAYOUTS`.
        seed: Of starts, spheres, targets and actions.
        num_envs: Worlds side by side.
        steps: Policy steps of each.
        terminate: Whether an event ends an episode; a non-finite state always does.
        episode_length: Policy steps until the time limit, which starts a new one.
    """
    new = jax.vmap(functools.partial(reset, env, policy, layout))
    advance = jax.vmap(functools.partial(step, env, policy))

    def one(worlds: World, key: Array) -> tuple[World, dict[str, Array]]:
        key_step, key_reset = jax.random.split(key)
        worlds, ended, figures = advance(worlds, jax.random.split(key_step, num_envs))
        over = worlds.age >= episode_length
        over |= ended if terminate else figures["nonfinite"] > 0
        fresh = functools.partial(_refresh, new, over)
        worlds = jax.lax.cond(over.any(), fresh, lambda w, _: w, worlds, key_reset)
        return worlds, figures

    @jax.jit
    def run(key: Array) -> dict[str, Array]:
        key_start, key_run = jax.random.split(key)
        worlds = new(jax.random.split(key_start, num_envs))
        return jax.lax.scan(one, worlds, jax.random.split(key_run, steps))[1]

    return jax.tree.map(np.asarray, run(jax.random.key(seed)))


def _refresh(new: Any, over: Array, worlds: World, key: Array) -> World:
    """Reset the worlds whose episode is over."""

    def pick(fresh: Array, old: Array) -> Array:
        mask = over.reshape(over.shape + (1,) * (old.ndim - 1))
        return jnp.where(mask, fresh.astype(old.dtype), old)

    return jax.tree.map(pick, new(jax.random.split(key, over.shape[0])), worlds)
