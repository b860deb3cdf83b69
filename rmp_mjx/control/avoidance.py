"""The collision branches of the tree: control points, and the arm itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from rmp_mjx.control.leaves import CollisionLeaf, leaf_of
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.pytree import Constant
from rmp_mjx.rmp import RMP, ScalarLeaf
from rmp_mjx.rmp.leaf import Param
from rmp_mjx.robot.kinematics import (
    ArmState,
    Motion,
    base_point,
    carry_points,
    motion_of,
    select,
)
from rmp_mjx.robot.model import Robot
from rmp_mjx.robot.point_state import (
    PointRMP,
    PointState,
    point_carrier,
    point_state,
    pull_to_joints,
)
from rmp_mjx.shapes import Gap
from rmp_mjx.vec import Vec
from rmp_mjx.xla import materialize


def per_link(
    robot: Robot, values: Float[ArrayLike, " n"] | Sequence[float]
) -> Float[Array, " p"]:
    """A leaf parameter for every control point from one for every link, (n,).

    Raises:
        ValueError: There are not as many values as links.
    """
    if np.shape(values) != (robot.n,):
        raise ValueError(
            f"per_link needs a value for each of the {robot.n} links, "
            f"got shape {np.shape(values)}"
        )
    return jnp.asarray(values)[np.array(robot.points.segment, int)]


class Surroundings(NamedTuple):
    """What the collision leaves meet."""

    clearance: dict[str, Float[Array, ""]]
    """Least distance to each kind of obstacle there are slots for [m]; inf if none of
    them is in use."""
    pressed: Float[Array, ""]
    """Greatest acceleration of a near point towards an obstacle by contacts [m/s^2]."""


def obstacle_gaps(
    robot: Robot, points: PointState, obstacles: Obstacles
) -> dict[str, Gap]:
    """Gaps between every control point and every obstacle slot, by kind.

    Args:
        robot: The arm.
        points: Its control points, from `point_state`.
        obstacles: Padded obstacle slots.
    """
    world = points.x + Vec(*base_point(robot))
    rho = jnp.asarray(robot.points.radius, points.x.x.dtype)
    return obstacles.gaps(world, points.v, rho, robot.points.hand)


def obstacle_branch(
    robot: Robot,
    arm: ArmState,
    obstacles: Obstacles,
    leaf: CollisionLeaf,
    w: Float[Array, " n"] | None = None,
    near: Float[Constant, ""] | float = 0.0,
) -> tuple[RMP, Surroundings]:
    """Collision leaves between every control point and every obstacle.

    Distances are mapped to points (their RMPs summed over the obstacles, a 3-vector
    and a 3x3 matrix each), points to joints.

    Args:
        robot: The arm.
        arm: Its state.
        obstacles: The obstacles.
        leaf: The leaf, or one for each kind.
        w: Joint acceleration by contacts, (n,) [rad/s^2]; None: nothing touches.
        near: Distance within which a point counts as near [m].

    Returns:
        The RMP on the joints, and what is about.
    """
    points = point_state(robot, arm)
    total, clearance, pressed = None, {}, jnp.zeros((), arm.p.dtype)
    push = None
    if w is not None:
        pushed = select(motion_of(robot, arm.S, w), point_carrier(robot))
        push = pushed.at(points.x).map(lambda c: c[None])
    for kind, gap in obstacle_gaps(robot, points, obstacles).items():
        clearance[kind] = jnp.min(
            jnp.where(gap.active, gap.distance, jnp.inf), initial=jnp.inf
        )
        own = leaf_of(leaf, kind)
        along = None if push is None else gap.normal @ push
        if along is not None:
            close = gap.active & (gap.distance < near)
            pressed = jnp.maximum(
                pressed, jnp.max(jnp.where(close, -along, 0.0), initial=0.0)
            )
        if own is not None:
            rmp = _sum_obstacles(gap, jax.tree.map(_for_all_obstacles, own), along)
            total = rmp if total is None else jax.tree.map(jnp.add, total, rmp)
    around = Surroundings(clearance, pressed)
    if total is None or not robot.points.segment:
        return RMP.zero(robot.n, arm.p.dtype), around
    return pull_to_joints(robot, arm, points, total), around


def _for_all_obstacles(parameter: Param) -> Param:
    """A parameter that is one for each point, with an axis for the obstacles."""
    return jnp.asarray(parameter)[None] if jnp.ndim(parameter) == 1 else parameter


def _sum_obstacles(gap: Gap, leaf: ScalarLeaf, push: Array | None) -> PointRMP:
    """Pull the leaves back from distances to points and add the obstacles' shares."""
    f, m = _scalar(leaf, gap.distance, gap.rate, push)
    f = jnp.where(gap.active, f - m * gap.curvature, 0.0)
    m = jnp.where(gap.active, m, 0.0)
    n = gap.normal
    mn = n * m

    def total(share: Array) -> Array:
        return jnp.sum(share, axis=0)

    return PointRMP(
        Vec(total(n.x * f), total(n.y * f), total(n.z * f)),
        *(total(mn.x * n.x), total(mn.x * n.y), total(mn.x * n.z)),
        *(total(mn.y * n.y), total(mn.y * n.z), total(mn.z * n.z)),
    )


def _scalar(
    leaf: ScalarLeaf, x: Array, xd: Array, push: Array | None
) -> tuple[Array, Array]:
    """Force and metric of the leaf, against contacts if there are any."""
    return leaf.scalar(x, xd) if push is None else leaf.scalar_against(x, xd, push)


def self_branch(
    robot: Robot, arm: ArmState, leaf: ScalarLeaf, w: Float[Array, " n"] | None = None
) -> RMP:
    """Collision leaves between the link capsules that can touch.

    Args:
        robot: The arm.
        arm: Its state.
        leaf: The leaf.
        w: Joint acceleration by contacts, (n,) [rad/s^2]; None: nothing touches.

    Returns:
        RMP on the joints; f (n,), M (n, n).
    """
    if not robot.capsules.pairs:
        return RMP.zero(robot.n, arm.p.dtype)
    distance, rate, curvature, rows = self_gaps(robot, arm)
    push = None if w is None else jnp.matmul(rows, w, precision="highest")
    f, m = _scalar(leaf, distance, rate, push)
    f, m, rows = materialize(f - m * curvature), materialize(m), materialize(rows)
    return RMP(
        f=jnp.sum(rows * f[:, None], axis=0),
        M=jnp.sum((rows * m[:, None])[:, :, None] * rows[:, None, :], axis=0),
    )


def self_gaps(
    robot: Robot, arm: ArmState
) -> tuple[
    Float[Array, " k"], Float[Array, " k"], Float[Array, " k"], Float[Array, "k n"]
]:
    r"""Distances of the k pairs of link capsules that can touch.

    The distance of two capsules depends on the joints between them only: with the
    unit force along the gap, $w = (\hat n, p \times \hat n)$,

    $$
    \dot d = w \cdot (V_a - V_b), \quad
    \ddot d = w^T S_{ab}\, \ddot q + w \cdot (A_a - A_b) + \dot w \cdot (V_a - V_b).
    $$

    Returns:
        Distance [m], rate [m/s], the acceleration's part without qdd [m/s^2], gradient.
    """
    pairs = capsule_pairs(robot, arm)
    x, segment = pairs.ends, pairs.segment
    V, A = (select(motion, pairs.relative) for motion in (arm.V, arm.A))
    v = select(arm.V, pairs.carrier).at(x)

    def unit_wrench(x: Vec) -> tuple[Motion, Array]:
        g, p, norm = segment_gap(x)
        normal = g * (1.0 / norm)
        return Motion(normal, p.cross(normal)), norm

    (w, norm), (wdot, _) = jax.jvp(unit_wrench, (x,), (v,))
    rate = w.lin @ V.lin + w.ang @ V.ang
    curvature = w.lin @ A.lin + w.ang @ A.ang + wdot.lin @ V.lin + wdot.ang @ V.ang
    joints = np.arange(robot.n)
    between = (joints > segment[1][:, None]) & (joints <= segment[0][:, None])
    rows = jnp.sum(w.stack()[:, :, None] * arm.S.stack()[:, None, :], axis=0)
    rows = jnp.where(between, rows, 0.0)
    return norm - pairs.reach, rate, curvature, rows


class CapsulePairs(NamedTuple):
    """The k pairs of link capsules that can touch: a far link's and a near one's."""

    ends: Vec
    """Starts of the far capsules, their ends, starts and ends of the near ones, (4k,),
    relative to the arm's base point [m]."""
    carrier: Float[np.ndarray, "n ends"]
    """Which link carries which end, one-hot."""
    segment: Int[np.ndarray, "2 k"]
    """Joints that carry the far and the near link; -1 for the base."""
    relative: Float[np.ndarray, "n k"]
    """Far link less near link: `select` with it gives the relative motion."""
    reach: Float[Array, " k"]
    """Sum of both radii [m]."""


def capsule_pairs(robot: Robot, arm: ArmState) -> CapsulePairs:
    """The pairs in this state; there must be some."""
    capsules = robot.capsules
    ids = np.array(capsules.pairs).T
    segment = np.array(capsules.segment)[ids]
    far, near = (np.arange(robot.n)[:, None] == s for s in segment)
    sides = [(end, side) for side in (0, 1) for end in (capsules.start, capsules.end)]
    offset = jnp.concatenate([end[ids[side]] for end, side in sides])
    x, carrier = carry_points(robot, arm, offset, np.repeat(segment, 2, axis=0).ravel())
    reach = jnp.sum(capsules.radius[ids], axis=0)
    return CapsulePairs(x, carrier, segment, 1.0 * far - near, reach)


def segment_gap(x: Vec) -> tuple[Vec, Vec, Array]:
    """Closest points of segment pairs: vector from near to far, a point, distance.

    x holds the starts and ends of the far segments, then those of the near ones.

    Ericson, "Real-Time Collision Detection" (2005), section 5.1.9, with the clamps
    written as selections so that values and derivatives are finite for parallel and
    degenerate segments.
    """
    a, a_end, b, b_end = (
        x.map(lambda c, i=i: c[i * (len(c) // 4) : (i + 1) * (len(c) // 4)])
        for i in range(4)
    )
    da, db = a_end - a, b_end - b
    r = a - b
    aa, bb, ab = da @ da, db @ db, da @ db
    ar, br = da @ r, db @ r
    tiny = 1e-9
    determinant = aa * bb - ab * ab
    parallel = determinant <= 1e-6 * aa * bb + tiny
    s = jnp.where(
        parallel, 0.5, (ab * br - ar * bb) / jnp.where(parallel, 1.0, determinant)
    )
    s = jnp.clip(s, 0.0, 1.0)
    t = jnp.clip(_ratio(ab * s + br, bb, tiny), 0.0, 1.0)
    s = jnp.clip(_ratio(ab * t - ar, aa, tiny), 0.0, 1.0)
    g = r + da * s - db * t
    squared = g @ g
    touching = squared <= tiny**2
    norm = jnp.sqrt(jnp.where(touching, tiny**2, squared))
    return g, b + db * t, norm


def _ratio(numerator: Array, denominator: Array, tiny: float) -> Array:
    """The quotient, or 0 for a segment of no length."""
    short = denominator <= tiny
    return jnp.where(short, 0.0, numerator / jnp.where(short, 1.0, denominator))
