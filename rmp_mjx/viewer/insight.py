r"""What the tree thinks of a state: who pulls, how hard, and who gets its way.

A branch with force f and metric M asks the root for $M \ddot q = f$. What it misses
when the arm accelerates by $\ddot q$ is $f - M \ddot q$. Both are joint torques, and
their size is that of the acceleration they would give the arm: the norm of
$M_q^{-1}$.
"""

from __future__ import annotations

import functools
import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rmp_mjx.control import RMPVICES
from rmp_mjx.control.avoidance import obstacle_gaps
from rmp_mjx.control.leaves import Leaves, leaf_of
from rmp_mjx.control.torque import stop_time
from rmp_mjx.math import inverse_root, psd_solve
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import ArmState, arm_state, base_point, site_state
from rmp_mjx.robot.point_state import PointState, point_state
from rmp_mjx.types import Setpoint
from rmp_mjx.vec import Vec

AT_A_POINT = ("collision", "self_collision")
"""Branches whose pull is shown at the heaviest control point, not at the hand."""


class Insight(NamedTuple):
    """What the tree thinks; b branches, p control points, n joints."""

    asked: dict[str, Float[Array, ""]]
    """Size of what each branch asks [kg^(1/2) m/s^2]."""
    missed: dict[str, Float[Array, ""]]
    """Size of what it does not get; 0: it gets its way."""
    start: dict[str, Float[Array, " 3"]]
    """Where each branch's pull is shown, world frame [m]."""
    pull: dict[str, Float[Array, " 3"]]
    """Acceleration that it alone would give that point [m/s^2]."""
    points: Float[Array, "p 3"]
    """Control points, world frame [m]."""
    weight: Float[Array, " p"]
    """Metric of each point's heaviest obstacle."""
    clearance: Float[Array, ""]
    """Least distance of a control point to an obstacle [m]; inf: there is none."""
    gap: Float[Array, "2 3"]
    """Its ends: on the arm's surface and on the obstacle's [m]."""
    eigenvalues: Float[Array, " n"]
    """Of the root's metric, relative to the inertia, least first."""


def think(
    controller: RMPVICES,
    q: Float[Array, " n"],
    qd: Float[Array, " n"],
    qdd: Float[Array, " n"],
    setpoint: Setpoint,
    obstacles: Obstacles,
    tau_ext: Float[Array, " n"],
) -> Insight:
    """What the tree thinks of a state in which the arm accelerates by qdd.

    Args:
        controller: The tree.
        q: Joint positions, (n,) [rad].
        qd: Joint velocities, (n,) [rad/s].
        qdd: What the controller in charge makes of it, (n,) [rad/s^2].
        setpoint: Impedance target.
        obstacles: Padded obstacle slots.
        tau_ext: Joint torque of the contacts, (n,) [N m].
    """
    robot = controller.robot
    arm = arm_state(robot, q, qd)
    Mq, bias = dynamics(robot, arm)
    R = inverse_root(Mq)

    def size(f: Array) -> Array:
        return jnp.sqrt(jnp.sum((R @ f) ** 2))

    branches = controller.asked(arm, setpoint, obstacles, tau_ext)
    root = functools.reduce(operator.add, [rmp.M for rmp in branches.values()])
    state = point_state(robot, arm)
    world = (state.x + Vec(*base_point(robot))).stack(1)
    leaves = controller.leaves
    if controller.braking_share is not None:
        share, tau_max = controller.braking_share, jnp.asarray(robot.tau_max)
        leaves = leaves.braking(stop_time(Mq, bias - tau_ext, qd, tau_max, share))
    leaves = leaves.weighted(setpoint.weights)
    weight, clearance, gap = _nearest(controller, leaves, world, state, obstacles)
    site = site_state(robot, arm)
    heaviest = jnp.argmax(weight)
    J_point = _point_jacobian(controller, arm, state.x.stack(1)[heaviest], heaviest)
    start, pull = {}, {}
    for name, rmp in branches.items():
        at_point = name in AT_A_POINT
        J = J_point if at_point else site.J_pos
        start[name] = world[heaviest] if at_point else site.p
        pull[name] = J @ psd_solve(Mq, rmp.f)
    relative = R @ root @ R.T
    return Insight(
        asked={name: size(rmp.f) for name, rmp in branches.items()},
        missed={name: size(rmp.f - rmp.M @ qdd) for name, rmp in branches.items()},
        start=start,
        pull=pull,
        points=world,
        weight=weight,
        clearance=clearance,
        gap=gap,
        eigenvalues=jnp.linalg.eigvalsh(0.5 * (relative + relative.T)),
    )


def _nearest(
    controller: RMPVICES,
    leaves: Leaves,
    world: Array,
    points: PointState,
    obstacles: Obstacles,
) -> tuple[Array, Array, Array]:
    """Weights of the control points, the least clearance and the ends of its gap."""
    robot = controller.robot
    rho = jnp.asarray(robot.points.radius, world.dtype)
    weight = jnp.zeros(len(world), world.dtype)
    clearance, ends = jnp.array(jnp.inf, world.dtype), jnp.zeros((2, 3), world.dtype)
    for kind, gap in obstacle_gaps(robot, points, obstacles).items():
        leaf = leaf_of(leaves.collision, kind)
        if leaf is not None:
            m = jnp.where(gap.active, leaf.scalar(gap.distance, gap.rate)[1], 0.0)
            weight = jnp.maximum(weight, jnp.max(m, axis=0))
        distance = jnp.where(gap.active, gap.distance, jnp.inf)
        at = jnp.unravel_index(jnp.argmin(distance), distance.shape)
        full = gap.normal.map(lambda c, d=distance: jnp.broadcast_to(c, d.shape))
        normal = jnp.stack([full.x[at], full.y[at], full.z[at]])
        skin = world[at[1]] - rho[at[1]] * normal
        there = skin - distance[at] * normal
        nearer = distance[at] < clearance
        ends = jnp.where(nearer, jnp.stack([skin, there]), ends)
        clearance = jnp.minimum(clearance, distance[at])
    return weight, clearance, ends


def _point_jacobian(
    controller: RMPVICES, arm: ArmState, x: Array, point: Array
) -> Array:
    """Velocity of a control point per joint velocity, (3, n)."""
    segment = jnp.asarray(np.array(controller.robot.points.segment, int))[point]
    J = arm.S.at(Vec(x[0], x[1], x[2])).stack()
    return jnp.where(jnp.arange(controller.robot.n)[None] <= segment, J, 0.0)


def on_host(insight: Insight) -> Insight:
    """The same as NumPy arrays."""
    return jax.device_get(insight)
