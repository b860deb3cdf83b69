"""The controller on random reaches among spheres, simulated by MuJoCo."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from rmp_mjx import sim
from rmp_mjx.control import RMPVICES, Controller
from rmp_mjx.math import log_so3
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.pytree import Pytree
from rmp_mjx.robot import Robot
from rmp_mjx.robot.configurations import (
    capsule_ends,
    capsule_gaps,
    joint_frames,
    random_configurations,
    segment_distance,
)
from rmp_mjx.robot.dynamics import holding_torque
from rmp_mjx.robot.kinematics import arm_state, site_pose
from rmp_mjx.types import Action

PERIOD = 0.005
"""Time of a control and physics step [s]."""

HOLD = 10
"""Steps between two set-points: 20 Hz."""

DURATION = 6.0
"""Time of a reach [s]."""

TURN = 0.2
"""Greatest turn of a set-point about an axis [rad]."""

STIFFNESS = 200.0
"""Stiffness of the set-points [1/s^2]."""

FROM_END = 0.1
"""Distance from the end of a joint's range that counts as an event [rad or m]."""

BLOCKED = 4
"""Of every so many reaches, one has no sphere in its way."""


class Draws(NamedTuple):
    """Goals from the home posture, and a sphere in the way of most of them."""

    goal: np.ndarray
    """Where the hand is to go, (k, 3) [m]."""
    rotation: np.ndarray
    """How it is to be turned there, (k, 3, 3)."""
    sphere: np.ndarray
    """Centre of the sphere, (k, 3) [m]."""
    blocked: np.ndarray
    """Whether it is in the way (or far off), (k,)."""
    radius: float
    """Its radius, which is the tolerance at the goal, too [m]."""


class Track(Pytree):
    """What one reach has seen so far; greatest values."""

    nearest: Float[Array, ""]
    """Least distance to the goal [m]."""
    touched: Float[Array, ""]
    """1 if the arm has touched the sphere."""
    crossed: Float[Array, ""]
    """1 if the arm has touched itself."""
    room: Float[Array, " n"]
    """Least distances from the ends of the joints' ranges [rad or m]."""
    speed: Float[Array, " n"]
    """Joint speeds [rad/s or m/s]."""
    acceleration: Float[Array, " n"]
    """Joint accelerations [rad/s^2 or m/s^2]."""
    rate: Float[Array, " n"]
    """Rates of the torques [N m/s or N/s]."""
    limited: Float[Array, ""]
    """Number of steps in which a motor was at its limit."""


def greatest(values: ArrayLike) -> np.ndarray:
    """The greatest of each joint over the reaches that did not blow up, (n,)."""
    seen = np.asarray(values)
    return np.max(np.where(np.isfinite(seen), seen, 0.0), axis=0)


def reach_of(robot: Robot) -> float:
    """Length of the stretched arm, from its second joint on [m]."""
    lengths = np.linalg.norm(np.asarray(robot.offset)[1:], axis=1)
    slides = ~np.array(robot.hinge)
    travel = np.where(slides, np.asarray(robot.q_upper) - robot.q_lower, 0.0)
    travel = np.where(np.isfinite(travel), travel, 0.0)
    tip = float(np.linalg.norm(robot.site_offset))
    return float(lengths.sum() + tip + travel.sum())


def draw_reaches(robot: Robot, count: int, seed: int = 0) -> Draws:
    """Goals 0.3 to 0.7 of the arm's reach away, each with a sphere half-way.

    The hand is to be where and as it is in a posture within 1.2 rad of home that is
    clear of itself. Neither home nor that posture is within 3 cm of the sphere.

    Raises:
        ValueError: Hardly any random posture makes a reach.
    """
    rng, reach = np.random.default_rng(seed), reach_of(robot)
    home, radius = np.asarray(robot.q_home)[None], 0.06 * reach
    start = _hand(robot, home)[0][0]
    drawn = random_configurations(robot, 40 * count + 2000, seed)
    q = home + np.clip(drawn - home, -1.2, 1.2)
    goal, rotation = _hand(robot, q)
    away = np.linalg.norm(goal - start, axis=1)
    good = (away > 0.3 * reach) & (away < 0.7 * reach)
    if robot.capsules.pairs:
        good &= capsule_gaps(robot, q, robot.capsules.pairs).min(axis=1) > 0.02
    share = rng.uniform(0.4, 0.6, (len(q), 1))
    sphere = start + share * (goal - start) + rng.uniform(-0.02, 0.02, goal.shape)
    for posture in (q, np.repeat(home, len(q), axis=0)):
        good &= _clearance(robot, posture, sphere) > radius + 0.03
    chosen = np.flatnonzero(good)[:count]
    if len(chosen) < max(1, count // 4):
        raise ValueError(
            f"only {len(chosen)} of {len(q)} random postures make a reach from q_home: "
            "choose a posture with room around the hand"
        )
    chosen = np.resize(chosen, count)
    blocked = np.arange(count) % BLOCKED != 0
    far = np.array([0.0, 0.0, 10.0 * reach])
    sphere = np.where(blocked[:, None], sphere[chosen], far)
    return Draws(goal[chosen], rotation[chosen], sphere, blocked, radius)


def run_reaches(
    robot: Robot, draws: Draws, make: Callable[..., Controller] = RMPVICES
) -> Track:
    """Simulate all reaches; entries lead with the reach.

    Args:
        robot: The arm.
        draws: What is to be reached.
        make: The controller, `make(robot, period=)`.
    """
    model = _scene(robot, draws.radius)
    physics = sim.load_physics("mujoco", model)
    ctrl = make(robot, period=PERIOD)
    spheres = len(set(robot.capsules.geom))
    step = 0.06 * reach_of(robot)
    steps = int(DURATION / PERIOD) // HOLD
    home = jnp.asarray(robot.q_home)
    holding = holding_torque(robot, arm_state(robot, home, 0.0 * home))
    low, high = jnp.asarray(robot.q_lower), jnp.asarray(robot.q_upper)

    def reach(goal, rotation, sphere):
        around = Obstacles.empty(spheres=1).with_spheres(
            sphere[None], jnp.array([draws.radius])
        )
        zero, held = jnp.zeros(robot.n), jnp.asarray(holding, jnp.float32)
        state = physics.init(jnp.asarray(robot.q_home, jnp.float32), zero, sphere[None])
        nothing, endless = jnp.zeros(()), jnp.full(robot.n, jnp.inf)
        track = Track(
            jnp.array(jnp.inf), nothing, nothing, endless, zero, zero, zero, nothing
        )

        def policy_step(carry, k):
            state, tau, track = carry
            x, R = site_pose(robot, state.qpos)
            turn = log_so3(rotation @ R.T)
            action = Action(
                dpos=jnp.clip(goal - x, -step, step),
                drot=jnp.clip(turn, -TURN, TURN),
                kp_pos=jnp.full(3, STIFFNESS),
                kp_ori=jnp.full(3, STIFFNESS),
            )
            setpoint = ctrl.setpoint(state.qpos, action, k * HOLD * PERIOD)

            def control_step(carry, _):
                state, last, track = carry
                out = ctrl(state.qpos, state.qvel, setpoint, around, tau_last=last)
                after = physics.step(state, out.tau)
                contacts = sim.read_contacts(model, after).touching
                hand = site_pose(robot, after.qpos)[0]
                room = jnp.minimum(after.qpos - low, high - after.qpos)
                rate = (out.tau - last) / PERIOD
                at_limit = jnp.any(out.diagnostics["torque_limit"] != 0.0)
                track = Track(
                    jnp.minimum(track.nearest, jnp.linalg.norm(hand - goal)),
                    jnp.maximum(track.touched, jnp.any(contacts[:spheres])),
                    jnp.maximum(track.crossed, jnp.any(contacts[spheres:])),
                    jnp.minimum(track.room, room),
                    jnp.maximum(track.speed, jnp.abs(after.qvel)),
                    jnp.maximum(
                        track.acceleration, jnp.abs(after.qvel - state.qvel) / PERIOD
                    ),
                    jnp.maximum(track.rate, jnp.abs(rate)),
                    track.limited + at_limit,
                )
                return (after, out.tau, track), None

            carry, _ = jax.lax.scan(control_step, (state, tau, track), None, HOLD)
            return carry, None

        (_, _, track), _ = jax.lax.scan(
            policy_step, (state, held, track), jnp.arange(steps)
        )
        return track

    run = jax.jit(jax.vmap(reach))
    wanted = (draws.goal, draws.rotation, draws.sphere)
    return jax.device_get(run(*(jnp.asarray(x, jnp.float32) for x in wanted)))


def _scene(robot: Robot, radius: float) -> mujoco.MjModel:
    """The arm with a sphere that touches its geoms, and these each other."""
    spec = robot.mj_spec
    spec.option.timestep = PERIOD
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    ball = spec.worldbody.add_body(name="check/ball", mocap=True)
    ball.add_geom(
        name="check/ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0.0, 0.0]
    )
    geoms, capsules = tuple(dict.fromkeys(robot.capsules.geom)), robot.capsules
    own = {(capsules.geom[a], capsules.geom[b]) for a, b in capsules.pairs}
    sim.add_pairs(spec, [(geom, "check/ball") for geom in geoms])
    sim.add_pairs(spec, sorted(own))
    return spec.compile()


def _hand(robot: Robot, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World positions (s, 3) [m] and orientations (s, 3, 3) of the end effector."""
    p, R = joint_frames(robot, q)
    return p[-1] + R[-1] @ robot.site_offset, R[-1] @ robot.site_rotation


def _clearance(robot: Robot, q: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Least distances of points (s, 3) from the moving capsules' surfaces, (s,) [m]."""
    radius, least = robot.capsules.radius, np.full(len(q), np.inf)
    every = range(len(robot.capsules.segment))
    for c, (start, end) in capsule_ends(robot, q, every).items():
        least = np.minimum(least, segment_distance(x, x, start, end) - radius[c])
    return least
