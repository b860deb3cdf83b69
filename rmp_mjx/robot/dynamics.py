"""Joint-space inertia and bias forces of the arm (Featherstone, 2008)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rmp_mjx.robot.kinematics import ArmState, joint_forces, joint_metric
from rmp_mjx.robot.model import Robot


def dynamics(
    robot: Robot, arm: ArmState
) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """Inertia and bias at one state: ``tau = Mq qdd + bias``.

    The inertia is the pullback of every link's spatial inertia, the bias that of the
    wrench it takes to move the links at qdd = 0: recursive Newton-Euler.

    Returns:
        Mq (n, n) [kg m^2], rotor inertias included, and bias (n,) [N m]: Coriolis,
        centrifugal and gravity, MuJoCo's ``qfrc_bias``.
    """
    n = robot.n
    mass = jnp.asarray(robot.mass, arm.p.dtype)
    c = (arm.p + _mv(arm.R, robot.com)).T
    inertia = jnp.einsum(
        "nij,njk,nlk->iln", arm.R, robot.inertia, arm.R, precision="highest"
    )
    v0, w = arm.V[:3], arm.V[3:]
    a0, alpha = arm.A[:3], arm.A[3:]
    velocity = v0 + jnp.cross(w, c, axis=0)
    acceleration = a0 + jnp.cross(alpha, c, axis=0) + jnp.cross(w, velocity, axis=0)
    force = mass * (acceleration - jnp.asarray(robot.gravity)[:, None])
    torque = _apply(inertia, alpha) + jnp.cross(w, _apply(inertia, w), axis=0)
    wrench = jnp.concatenate([force, jnp.cross(c, force, axis=0) + torque])

    outer = np.tril(np.ones((n, n)))  # sums over links k, k + 1, ...
    C = _skew(c)
    mC = mass * C
    mCC = jnp.einsum("ijn,jkn->ikn", mC, C, precision="highest")
    eye = jnp.eye(3)[:, :, None] * mass
    spatial = jnp.concatenate(
        [
            jnp.concatenate([eye, -mC], axis=1),
            jnp.concatenate([mC, inertia - mCC], axis=1),
        ]
    )
    composite = jnp.matmul(spatial, outer, precision="highest")
    Mq = joint_metric(arm.S, composite) + jnp.diag(jnp.asarray(robot.armature))
    bias = joint_forces(arm.S, jnp.matmul(wrench, outer, precision="highest"))
    return Mq, bias


def _mv(R: Array, x: Array) -> Array:
    return jnp.einsum("nij,nj->ni", R, x, precision="highest")


def _apply(inertia: Array, w: Array) -> Array:
    return jnp.sum(inertia * w[None], axis=1)


def _skew(c: Array) -> Array:
    zero = jnp.zeros_like(c[0])
    return jnp.stack(
        [
            jnp.stack([zero, -c[2], c[1]]),
            jnp.stack([c[2], zero, -c[0]]),
            jnp.stack([-c[1], c[0], zero]),
        ]
    )
