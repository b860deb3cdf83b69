r"""Kinematics of the chain in closed form, in spatial vectors.

All spatial vectors are about one fixed point (the first joint's reference position)
with axes of the world, linear part first: a twist :math:`V = (v_0, \omega)` gives the
body point at x the velocity :math:`v_0 + \omega \times x`. In these coordinates every
link sees the same joint columns S, so twists and accelerations are running sums, and
pulling wrenches and metrics back to the joints needs only sums over outer links:

.. math::
    V_i = \sum_{j \le i} S_j \dot q_j, \quad
    A_i = \sum_{j \le i} (V_j \times S_j) \dot q_j, \quad
    f_j = S_j^T \sum_{i \ge j} w_i, \quad
    M_{jk} = S_j^T \Bigl(\sum_{i \ge \max(j,k)} M_i\Bigr) S_k .

The last two are the recursive Newton-Euler and composite-rigid-body algorithms
(Featherstone, 2008), used here for inertias and for RMP metrics alike. They equal
the Jacobians that autodiff of `forward_kinematics` gives; the tests hold them to it.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from rmp_mjx.robot.model import Robot


@struct.dataclass
class ArmState:
    """Where every joint frame is and how it moves."""

    p: Float[Array, "n 3"]
    """Origins of the joint frames relative to `base_point` [m]."""
    R: Float[Array, "n 3 3"]
    """Orientations of the joint frames in the world."""
    S: Float[Array, "6 n"]
    """Joint columns: the twist of every outer link per unit of joint velocity."""
    V: Float[Array, "6 n"]
    """Twist of each link [m/s, rad/s]."""
    A: Float[Array, "6 n"]
    """Spatial acceleration of each link while qdd = 0 [m/s^2, rad/s^2]."""


def base_point(robot: Robot) -> Float[Array, " 3"]:
    """World position of the point about which spatial vectors are taken [m]."""
    return jnp.asarray(robot.offset[0])


def forward_kinematics(
    robot: Robot, q: Float[Array, " n"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"]]:
    """Joint frames relative to `base_point`.

    One constant transform and one turn about (or shift along) z per joint. The
    barrier between links stops XLA from recomputing the inner chain at every link,
    which its CPU fusion does otherwise.

    Args:
        robot: The arm.
        q: Joint coordinates, (n,) [rad or m].

    Returns:
        Origins (n, 3) [m] and world orientations (n, 3, 3).
    """
    shift = jnp.asarray(q) - robot.q_ref
    c, s = jnp.cos(shift), jnp.sin(shift)
    p, R = jnp.zeros(3, c.dtype), jnp.eye(3, dtype=c.dtype)
    origins, rotations = [], []
    for j in range(robot.n):
        if j > 0:
            p = p + _dot(R, robot.offset[j])
        R = _dot(R, robot.rotation[j])
        if robot.hinge[j]:
            x, y, z = R[:, 0], R[:, 1], R[:, 2]
            R = jnp.stack([c[j] * x + s[j] * y, c[j] * y - s[j] * x, z], axis=1)
        else:
            p = p + R[:, 2] * shift[j]
        p, R = jax.lax.optimization_barrier((p, R))
        origins.append(p)
        rotations.append(R)
    return jnp.stack(origins), jnp.stack(rotations)


def arm_state(robot: Robot, q: Float[Array, " n"], qd: Float[Array, " n"]) -> ArmState:
    """Frames, joint columns, twists and bias accelerations of the whole chain."""
    p, R = forward_kinematics(robot, q)
    z = R[:, :, 2].T
    hinge = np.array(robot.hinge)
    S = jnp.concatenate(
        [jnp.where(hinge, jnp.cross(p.T, z, axis=0), z), jnp.where(hinge, z, 0.0)]
    )
    inner = np.triu(np.ones((robot.n, robot.n)))
    V = _dot(S * qd, inner)
    A = _dot(cross_motion(V, S) * qd, inner)
    return ArmState(p=p, R=R, S=S, V=V, A=A)


def cross_motion(V: Float[Array, "6 n"], S: Float[Array, "6 n"]) -> Float[Array, "6 n"]:
    """Rate of change of motion vectors S carried along by the twists V."""
    v, w = V[:3], V[3:]
    return jnp.concatenate(
        [
            jnp.cross(w, S[:3], axis=0) + jnp.cross(v, S[3:], axis=0),
            jnp.cross(w, S[3:], axis=0),
        ]
    )


def joint_forces(S: Float[Array, "6 n"], W: Float[Array, "6 n"]) -> Float[Array, " n"]:
    """Joint forces of composite wrenches: column k sums the wrenches of links >= k."""
    return jnp.sum(S * W, axis=0)


def joint_metric(
    S: Float[Array, "6 n"], M: Float[Array, "6 6 n"]
) -> Float[Array, "n n"]:
    """Joint-space metric of composite 6x6 metrics (column k sums links >= k)."""
    F = jnp.sum(M * S[None], axis=1)
    G = jnp.einsum("ij,ik->jk", S, F, precision="highest")
    upper = np.triu(np.ones(G.shape, bool))
    return jnp.where(upper, G, G.T)


@struct.dataclass
class SiteState:
    """Pose and motion of the end-effector site."""

    p: Float[Array, " 3"]
    """World position [m]."""
    R: Float[Array, "3 3"]
    """World orientation."""
    v: Float[Array, " 3"]
    """Velocity [m/s]."""
    w: Float[Array, " 3"]
    """Angular velocity, world frame [rad/s]."""
    J_pos: Float[Array, "3 n"]
    """Translational Jacobian."""
    J_ori: Float[Array, "3 n"]
    """Rotational Jacobian, world frame."""
    Jdot_qd_pos: Float[Array, " 3"]
    """Translational curvature [m/s^2]."""
    Jdot_qd_ori: Float[Array, " 3"]
    """Rotational curvature [rad/s^2]."""


def site_pose(
    robot: Robot, q: Float[Array, " n"]
) -> tuple[Float[Array, " 3"], Float[Array, "3 3"]]:
    """World position (3,) [m] and orientation (3, 3) of the end-effector site."""
    p, R = forward_kinematics(robot, q)
    position = base_point(robot) + p[-1] + _dot(R[-1], robot.site_offset)
    return position, _dot(R[-1], robot.site_rotation)


def site_state(robot: Robot, arm: ArmState) -> SiteState:
    """Pose, velocity, Jacobians and curvature of the site."""
    x = arm.p[-1] + _dot(arm.R[-1], robot.site_offset)
    v0, w = arm.V[:3, -1], arm.V[3:, -1]
    a0, alpha = arm.A[:3, -1], arm.A[3:, -1]
    v = v0 + jnp.cross(w, x)
    return SiteState(
        p=base_point(robot) + x,
        R=_dot(arm.R[-1], robot.site_rotation),
        v=v,
        w=w,
        J_pos=arm.S[:3] + jnp.cross(arm.S[3:], x[:, None], axis=0),
        J_ori=arm.S[3:],
        Jdot_qd_pos=a0 + jnp.cross(alpha, x) + jnp.cross(w, v),
        Jdot_qd_ori=alpha,
    )


def _dot(a: Array, b: Array) -> Array:
    return jnp.matmul(a, jnp.asarray(b, a.dtype), precision="highest")
