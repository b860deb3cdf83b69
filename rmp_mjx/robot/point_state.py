"""Motion of the control points, and the pullback from them to the joints."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rmp_mjx.pytree import Pytree
from rmp_mjx.rmp import RMP
from rmp_mjx.robot.kinematics import (
    ArmState,
    Motion,
    carry_points,
    joint_forces,
    joint_metric,
    select,
)
from rmp_mjx.robot.model import Robot
from rmp_mjx.vec import Vec, xyz


class PointState(Pytree):
    """Position, velocity and bias acceleration of p control points, (p,) each."""

    x: Vec
    """Positions relative to the arm's base point [m]."""
    v: Vec
    """Velocities [m/s]."""
    a: Vec
    """Accelerations while qdd = 0 (the curvature Jdot qd) [m/s^2]."""


class PointRMP(Pytree):
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
    """Move the control points with the links."""
    x, carrier = carry_points(
        robot, arm, robot.points.offset, np.array(robot.points.segment, int)
    )
    V, A = select(arm.V, carrier), select(arm.A, carrier)
    v = V.at(x)
    return PointState(x, v, A.at(x) + V.ang.cross(v))


def point_carrier(robot: Robot) -> Float[np.ndarray, "n p"]:
    """Which link carries which control point: `select` with it, one-hot."""
    segment = np.array(robot.points.segment, int)
    return (np.arange(robot.n)[:, None] == segment[None]).astype(float)


def pull_to_joints(
    robot: Robot, arm: ArmState, points: PointState, rmp: PointRMP
) -> RMP:
    r"""Pull the points' RMPs back to the joints (RMPflow pullback, natural form).

    Each point's $f - M \dot J \dot q$ and M become a wrench and a 6x6 metric
    about the base point,

    $$
    \begin{pmatrix} M & M [x]_\times^T \\ [x]_\times M &
    [x]_\times M [x]_\times^T \end{pmatrix},
    $$

    which are summed over all points that move with or beyond each joint and then
    contracted with the joint columns.

    Returns:
        RMP on the joints; f (n,), M (n, n).
    """
    x, rows = points.x, rmp.rows
    force = rmp.f - Vec(*(row @ points.a for row in rows))
    # Columns of [x] M are x cross the rows of M (symmetric); then once more by rows.
    a, b, c = (x.cross(row) for row in rows)
    turned = [x.cross(Vec(*row)) for row in zip(xyz(a), xyz(b), xyz(c), strict=True)]
    fields = [*xyz(force), *xyz(x.cross(force))]
    fields += [rmp.xx, rmp.xy, rmp.xz, rmp.yy, rmp.yz, rmp.zz]
    fields += [*xyz(a), *xyz(b), *xyz(c)]
    fields += [turned[0].x, turned[0].y, turned[0].z]
    fields += [turned[1].y, turned[1].z, turned[2].z]
    segment = np.array(robot.points.segment, int)
    outward = (np.arange(robot.n) <= segment[:, None]).astype(float)
    sums = jnp.matmul(
        jnp.stack(jnp.broadcast_arrays(*fields)),
        jnp.asarray(outward, arm.p.dtype),
        precision="highest",
    )
    xx, xy, xz, yy, yz, zz = sums[6:12]
    a, b, c = (Vec.of(sums[i : i + 3], 0) for i in (12, 15, 18))
    txx, txy, txz, tyy, tyz, tzz = sums[21:]
    lin, ang = arm.S.lin, arm.S.ang
    momentum = Motion(
        Vec(Vec(xx, xy, xz) @ lin, Vec(xy, yy, yz) @ lin, Vec(xz, yz, zz) @ lin)
        + Vec(a @ ang, b @ ang, c @ ang),
        a * lin.x
        + b * lin.y
        + c * lin.z
        + Vec(
            Vec(txx, txy, txz) @ ang, Vec(txy, tyy, tyz) @ ang, Vec(txz, tyz, tzz) @ ang
        ),
    )
    return RMP(f=joint_forces(arm.S, sums[:6]), M=joint_metric(arm.S, momentum))
