r"""Kinematics of the chain in closed form, in spatial vectors.

All spatial vectors are about one fixed point (the first joint's reference position)
with axes of the world, linear part first: a twist $V = (v_0, \omega)$ gives the
body point at x the velocity $v_0 + \omega \times x$. In these coordinates every
link sees the same joint columns S, so twists and accelerations are running sums, and
pulling wrenches and metrics back to the joints needs only sums over outer links:

$$
V_i = \sum_{j \le i} S_j \dot q_j, \quad
A_i = \sum_{j \le i} (V_j \times S_j) \dot q_j, \quad
f_j = S_j^T \sum_{i \ge j} w_i, \quad
M_{jk} = S_j^T \Bigl(\sum_{i \ge \max(j,k)} M_i\Bigr) S_k .
$$

The last two are the recursive Newton-Euler and composite-rigid-body algorithms
(Featherstone, 2008), used here for inertias and for RMP metrics alike. They equal
the Jacobians that autodiff of `forward_kinematics` gives; the tests hold them to it.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rmp_mjx.pytree import Pytree
from rmp_mjx.robot.model import Robot
from rmp_mjx.types import Constant
from rmp_mjx.vec import Vec


class Motion(Pytree):
    """Spatial motion vectors (twists, joint columns, accelerations), one per column."""

    lin: Vec
    """Linear part: velocity of the body point at the base point."""
    ang: Vec
    """Angular part."""

    @staticmethod
    def of(array: Float[Array, "6 n"]) -> Motion:
        """Split (6, n), linear part first."""
        return Motion(Vec.of(array[:3], 0), Vec.of(array[3:], 0))

    def stack(self) -> Float[Array, "6 n"]:
        """Join into (6, n), linear part first."""
        return jnp.concatenate([self.lin.stack(), self.ang.stack()])

    def at(self, x: Vec) -> Vec:
        """Linear part at the points x."""
        return self.lin + self.ang.cross(x)

    def rate(self, S: Motion) -> Motion:
        """Rate of change of motion vectors S that these twists carry along."""
        return Motion(
            self.ang.cross(S.lin) + self.lin.cross(S.ang), self.ang.cross(S.ang)
        )

    def __mul__(self, s: Array) -> Motion:
        """Product with a scalar per column."""
        return Motion(self.lin * s, self.ang * s)


class ArmState(Pytree):
    """Where every joint frame is and how it moves."""

    q: Float[Array, " n"]
    """Joint coordinates [rad or m]."""
    qd: Float[Array, " n"]
    """Joint velocities [rad/s or m/s]."""
    p: Float[Array, "3 n"]
    """Origins of the joint frames relative to `base_point` [m]."""
    R: Float[Array, "3 3 n"]
    """Orientations of the joint frames in the world."""
    S: Motion
    """Joint columns: the twist of every outer link per unit of joint velocity."""
    V: Motion
    """Twist of each link [m/s, rad/s]."""
    A: Motion
    """Spatial acceleration of each link while qdd = 0 [m/s^2, rad/s^2]."""


def base_point(robot: Robot) -> Float[Array, " 3"]:
    """World position of the point about which spatial vectors are taken [m]."""
    return jnp.asarray(robot.offset[0])


def forward_kinematics(
    robot: Robot, q: Float[Array, " n"]
) -> tuple[Float[Array, "3 n"], Float[Array, "3 3 n"]]:
    """Joint frames relative to `base_point`.

    One constant transform and one turn about (or shift along) z per joint. The
    barrier between links stops XLA from recomputing the inner chain at every link,
    which its CPU fusion does otherwise.

    Args:
        robot: The arm.
        q: Joint coordinates, (n,) [rad or m].

    Returns:
        Origins (3, n) [m] and world orientations (3, 3, n).
    """
    q = jnp.asarray(q)
    shift = q - jnp.asarray(robot.q_ref, q.dtype)
    c, s = jnp.cos(shift), jnp.sin(shift)
    p, R = jnp.zeros(3, c.dtype), jnp.eye(3, dtype=c.dtype)
    origins, rotations = [], []
    for j in range(robot.n):
        if j > 0:
            p = p + _dot(R, robot.offset[j])
        R = _dot(R, robot.rotation[j])
        if robot.hinge[j]:
            x, y, z = R[:, 0], R[:, 1], R[:, -1]
            R = jnp.stack([c[j] * x + s[j] * y, c[j] * y - s[j] * x, z], axis=1)
        else:
            p = p + R[:, -1] * shift[j]
        p, R = jax.lax.optimization_barrier((p, R))
        origins.append(p)
        rotations.append(R)
    return jnp.stack(origins, axis=-1), jnp.stack(rotations, axis=-1)


def arm_state(robot: Robot, q: Float[Array, " n"], qd: Float[Array, " n"]) -> ArmState:
    """Frames, joint columns, twists and bias accelerations of the whole chain."""
    p, R = forward_kinematics(robot, q)
    z = Vec.of(R[:, -1], 0)
    hinge = np.array(robot.hinge)
    S = Motion(
        Vec.of(p, 0).cross(z).map(lambda turn, slide: jnp.where(hinge, turn, slide), z),
        z.map(lambda turn: jnp.where(hinge, turn, 0.0)),
    )
    V = motion_of(robot, S, qd)
    A = motion_of(robot, V.rate(S), qd)
    return ArmState(q=jnp.asarray(q), qd=jnp.asarray(qd), p=p, R=R, S=S, V=V, A=A)


def motion_of(robot: Robot, S: Motion, u: Float[Array, " n"]) -> Motion:
    """Motion of every link from that of the joints: columns k sum S_j u_j, j <= k."""
    inner = np.triu(np.ones((robot.n, robot.n)))
    return Motion.of(_dot((S * u).stack(), inner))


def joint_forces(S: Motion, W: Float[Array, "6 n"]) -> Float[Array, " n"]:
    """Joint forces of composite wrenches: column k sums the wrenches of links >= k."""
    w = Motion.of(W)
    return S.lin @ w.lin + S.ang @ w.ang


def joint_metric(S: Motion, F: Motion) -> Float[Array, "n n"]:
    r"""Joint-space metric $S_j \cdot F_k$ from composite momenta.

    Column k of F is the composite 6x6 metric of links >= k times joint column k.
    """

    def outer(a: Vec, b: Vec) -> Array:
        return a.map(lambda c: c[:, None]) @ b.map(lambda c: c[None])

    G = outer(S.lin, F.lin) + outer(S.ang, F.ang)
    upper = np.triu(np.ones(G.shape, bool))
    return jnp.where(upper, G, G.T)


class SiteState(Pytree):
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
    position = base_point(robot) + p[:, -1] + _dot(R[..., -1], robot.site_offset)
    return position, _dot(R[..., -1], robot.site_rotation)


def site_state(robot: Robot, arm: ArmState) -> SiteState:
    """Pose, velocity, Jacobians and curvature of the site."""
    R = arm.R[..., -1]
    x = arm.p[:, -1] + _dot(R, robot.site_offset)
    V, A = (jax.tree.map(lambda c: c[-1], motion) for motion in (arm.V, arm.A))
    at = Vec.of(x)
    v = V.at(at)
    return SiteState(
        p=base_point(robot) + x,
        R=_dot(R, robot.site_rotation),
        v=v.stack(),
        w=V.ang.stack(),
        J_pos=arm.S.at(at).stack(),
        J_ori=arm.S.ang.stack(),
        Jdot_qd_pos=(A.at(at) + V.ang.cross(v)).stack(),
        Jdot_qd_ori=A.ang.stack(),
    )


def carry_points(
    robot: Robot, arm: ArmState, offset: Constant, segment: np.ndarray
) -> tuple[Vec, np.ndarray]:
    """Move points with their links: three products with constant matrices.

    Args:
        robot: The arm.
        arm: Its state.
        offset: Points in the frames of their joints, (k, 3) [m]; in the world frame
            for segment -1.
        segment: Joint that moves each point, (k,); -1 for the fixed base.

    Returns:
        Positions relative to the base point, and which joint carries which point,
        one-hot (n, k): `select` with it gives the twist that moves each point.
    """
    return _carry(robot, arm.p, arm.R, offset, segment)


def point_positions(robot: Robot, q: Float[Array, " n"]) -> Float[Array, "p 3"]:
    """World positions of the control points (p, 3) [m] at joint coordinates q (n,)."""
    p, R = forward_kinematics(robot, q)
    segment = np.array(robot.points.segment, int)
    x, _ = _carry(robot, p, R, robot.points.offset, segment)
    return base_point(robot)[None] + x.stack(1)


def select(motion: Motion, carrier: np.ndarray) -> Motion:
    """Linear combinations of the columns of motion vectors, by a matrix (n, k)."""
    return Motion.of(_dot(motion.stack(), carrier))


def _carry(
    robot: Robot, p: Array, R: Array, offset: Constant, segment: np.ndarray
) -> tuple[Vec, np.ndarray]:
    """`carry_points` from the joint frames."""
    offset = jnp.asarray(offset, p.dtype)
    carrier = (np.arange(robot.n)[:, None] == segment[None]).astype(float)
    axes = jnp.concatenate([offset.T[:, None] * carrier[None], carrier[None]])
    frames = jnp.concatenate([R, p[:, None]], axis=1)
    x = _dot(frames.reshape(3, -1), axes.reshape(-1, len(segment)))
    if (segment < 0).any():
        fixed = (offset - base_point(robot)[None]) * (segment < 0)[:, None]
        x = x + fixed.T
    return Vec.of(x, 0), carrier


def _dot(a: Array, b: Constant) -> Array:
    return jnp.matmul(a, jnp.asarray(b, a.dtype), precision="highest")
