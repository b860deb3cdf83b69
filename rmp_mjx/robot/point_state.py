"""Motion of the control points, and the pullback from them to the joints."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from rmp_mjx.rmp import RMP
from rmp_mjx.robot.kinematics import ArmState, joint_forces, joint_metric
from rmp_mjx.robot.model import Robot
from rmp_mjx.vec import Vec


@struct.dataclass
class PointState:
    """Position, velocity and bias acceleration of p control points, (p,) each."""

    x: Vec
    """Positions relative to the arm's base point [m]."""
    v: Vec
    """Velocities [m/s]."""
    a: Vec
    """Accelerations while qdd = 0 (the curvature Jdot qd) [m/s^2]."""


@struct.dataclass
class PointRMP:
    """Sum of what all obstacles ask of each control point: natural form on R^3."""

    f: Vec
    """Force, (p,)."""
    xx: Array
    """Metric, entry (0, 0), (p,); the others likewise."""
    xy: Array
    """Entry (0, 1)."""
    xz: Array
    """Entry (0, 2)."""
    yy: Array
    """Entry (1, 1)."""
    yz: Array
    """Entry (1, 2)."""
    zz: Array
    """Entry (2, 2)."""

    @property
    def rows(self) -> tuple[Vec, Vec, Vec]:
        """The metric's rows."""
        return (
            Vec(self.xx, self.xy, self.xz),
            Vec(self.xy, self.yy, self.yz),
            Vec(self.xz, self.yz, self.zz),
        )


def point_state(robot: Robot, arm: ArmState) -> PointState:
    """Move the control points with the links.

    A point's position is linear in its link's (R, p), its velocity and acceleration
    in the link's twist and bias: three matrix products with constant matrices.
    """
    offset = np.asarray(robot.points.offset)
    carry = _carrier(robot)
    placed = np.concatenate([carry[:, None] * offset.T[None], carry[:, None]], axis=1)
    frames = jnp.concatenate([arm.R, arm.p[:, :, None]], axis=2)
    frames = jnp.swapaxes(frames, 0, 1).reshape(3, -1)
    x = Vec.of(_matmul(frames, placed.reshape(-1, offset.shape[0])), 0)
    twist = _matmul(arm.V, carry)
    bias = _matmul(arm.A, carry)
    w = Vec.of(twist[3:], 0)
    v = Vec.of(twist[:3], 0) + w.cross(x)
    a = Vec.of(bias[:3], 0) + Vec.of(bias[3:], 0).cross(x) + w.cross(v)
    return PointState(x, v, a)


def pull_to_joints(
    robot: Robot, arm: ArmState, points: PointState, rmp: PointRMP
) -> RMP:
    r"""Pull the points' RMPs back to the joints (RMPflow pullback, natural form).

    Each point's :math:`f - M \dot J \dot q` and M become a wrench and a 6x6 metric
    about the base point, which are summed over all points that move with or beyond
    each joint and then contracted with the joint columns.

    Returns:
        RMP on the joints; f (n,), M (n, n).
    """
    x, rows = points.x, rmp.rows
    force = rmp.f - Vec(*(row @ points.a for row in rows))
    moment = x.cross(force)
    # [x] M, column by column (M is symmetric), and [x] M [x]^T, row by row.
    columns = [x.cross(row) for row in rows]
    turned = [
        x.cross(Vec(columns[0].x, columns[1].x, columns[2].x)),
        x.cross(Vec(columns[0].y, columns[1].y, columns[2].y)),
        x.cross(Vec(columns[0].z, columns[1].z, columns[2].z)),
    ]
    fields = [*_parts(force), *_parts(moment)]
    fields += [rmp.xx, rmp.xy, rmp.xz, rmp.yy, rmp.yz, rmp.zz]
    for column in columns:
        fields += _parts(column)
    fields += [turned[0].x, turned[0].y, turned[0].z]
    fields += [turned[1].y, turned[1].z, turned[2].z]
    outward = np.cumsum(_carrier(robot)[::-1], axis=0)[::-1].T
    sums = _matmul(jnp.stack(jnp.broadcast_arrays(*fields)), outward)
    metric = sums[_METRIC_ORDER]
    return RMP(
        f=joint_forces(arm.S, sums[:6]),
        M=joint_metric(arm.S, metric.reshape(6, 6, -1)),
    )


_METRIC_ORDER = np.array(
    # linear-linear | linear-angular (= its transpose), symmetric 6x6, row by row
    [
        [6, 7, 8, 12, 13, 14],
        [7, 9, 10, 15, 16, 17],
        [8, 10, 11, 18, 19, 20],
        [12, 15, 18, 21, 22, 23],
        [13, 16, 19, 22, 24, 25],
        [14, 17, 20, 23, 25, 26],
    ]
).reshape(-1)


def _carrier(robot: Robot) -> np.ndarray:
    """Which joint moves each point: one-hot (n, p)."""
    segment = np.array(robot.points.segment, int)
    return (np.arange(robot.n)[:, None] == segment[None]).astype(float)


def _parts(v: Vec) -> list[Array]:
    return [v.x, v.y, v.z]


def _matmul(a: Array, b: np.ndarray) -> Array:
    return jnp.matmul(a, jnp.asarray(b, a.dtype), precision="highest")
