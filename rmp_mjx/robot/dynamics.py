"""Joint-space inertia and bias forces of the arm (Featherstone, 2008)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rmp_mjx.robot.kinematics import (
    ArmState,
    Motion,
    carry_points,
    joint_forces,
    joint_metric,
)
from rmp_mjx.robot.model import Robot
from rmp_mjx.vec import Vec, xyz
from rmp_mjx.xla import materialize


def dynamics(
    robot: Robot, arm: ArmState
) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """Inertia and bias at one state: ``tau = Mq qdd + bias``.

    The inertia is the pullback of every link's spatial inertia, the bias that of the
    wrench it takes to move the links at qdd = 0: recursive Newton-Euler. The bias also
    holds up the joints' springs and dampers, where the robot has any.

    Returns:
        Mq (n, n) [kg m^2], rotor inertias included, and bias (n,) [N m]: Coriolis,
        centrifugal and gravity (MuJoCo's ``qfrc_bias``), minus the forces of dampers
        and springs (its ``qfrc_passive``).
    """
    n = robot.n
    mass = jnp.asarray(robot.mass, arm.p.dtype)
    c, _ = carry_points(robot, arm, robot.com, np.arange(n))
    rows = _world_inertia(robot, arm)
    w, alpha = arm.V.ang, arm.A.ang
    gravity = Vec.of(jnp.asarray(robot.gravity, arm.p.dtype))
    acceleration = arm.A.at(c) + w.cross(arm.V.at(c)) - gravity
    force = acceleration * mass
    spin = Vec(*(row @ w for row in rows))
    torque = Vec(*(row @ alpha for row in rows)) + w.cross(spin) + c.cross(force)

    # Inertia about the base point: Ic + m (c.c 1 - c c^T).
    moment = c * mass
    cc = moment @ c
    xx, yy, zz = (
        row[i] + cc - m * x
        for i, (row, m, x) in enumerate(
            zip(map(xyz, rows), xyz(moment), xyz(c), strict=True)
        )
    )
    xy = rows[0].y - moment.x * c.y
    xz = rows[0].z - moment.x * c.z
    yz = rows[1].z - moment.y * c.z
    own = [mass, *xyz(moment), xx, xy, xz, yy, yz, zz, *xyz(force), *xyz(torque)]
    outward = np.tril(np.ones((n, n)))  # sums over links k, k + 1, ...
    sums = jnp.matmul(
        jnp.stack(own), jnp.asarray(outward, arm.p.dtype), precision="highest"
    )
    mass, moment = sums[0], Vec.of(sums[1:4], 0)
    xx, xy, xz, yy, yz, zz = sums[4:10]
    inertia = (Vec(xx, xy, xz), Vec(xy, yy, yz), Vec(xz, yz, zz))
    S = arm.S
    momentum = Motion(
        S.lin * mass + S.ang.cross(moment),
        moment.cross(S.lin) + Vec(*(row @ S.ang for row in inertia)),
    )
    rotors = jnp.diag(jnp.asarray(robot.armature, arm.p.dtype))
    Mq = materialize(joint_metric(S, momentum) + rotors)
    return Mq, _hold_passive(robot, arm, joint_forces(S, sums[10:]))


def holding_torque(robot: Robot, arm: ArmState) -> Float[Array, " n"]:
    """Torque that holds the arm at rest against gravity and its springs, (n,) [N m].

    It is the bias at qd = 0.
    """
    c, _ = carry_points(robot, arm, robot.com, np.arange(robot.n))
    mass = jnp.asarray(robot.mass, arm.p.dtype)
    gravity = Vec.of(jnp.asarray(robot.gravity, arm.p.dtype))
    force = gravity.map(lambda g: -g * mass)
    own = jnp.concatenate([force.stack(), c.cross(force).stack()])
    outward = jnp.asarray(np.tril(np.ones((robot.n, robot.n))), arm.p.dtype)
    held = joint_forces(arm.S, jnp.matmul(own, outward, precision="highest"))
    return _hold_passive(robot, arm.replace(qd=jnp.zeros_like(arm.qd)), held)


def _hold_passive(robot: Robot, arm: ArmState, bias: Array) -> Array:
    """The bias plus what balances the joints' dampers and springs."""
    dtype = arm.p.dtype
    if robot.damping is not None:
        bias = bias + jnp.asarray(robot.damping, dtype) * arm.qd
    if robot.stiffness is not None:
        stretch = arm.q - jnp.asarray(robot.spring_ref, dtype)
        bias = bias + jnp.asarray(robot.stiffness, dtype) * stretch
    return bias


def _world_inertia(robot: Robot, arm: ArmState) -> tuple[Vec, Vec, Vec]:
    """Rows of R I R^T for every link, about its centre of mass."""
    inertia = jnp.asarray(robot.inertia, arm.R.dtype)
    R = [Vec.of(arm.R[i], 0) for i in range(3)]
    RI = [
        Vec(
            *(
                row.x * inertia[:, 0, j]
                + row.y * inertia[:, 1, j]
                + row.z * inertia[:, -1, j]
                for j in range(3)
            )
        )
        for row in R
    ]
    a, b, c = RI
    xy, xz, yz = a @ R[1], a @ R[2], b @ R[2]
    return Vec(a @ R[0], xy, xz), Vec(xy, b @ R[1], yz), Vec(xz, yz, c @ R[2])
