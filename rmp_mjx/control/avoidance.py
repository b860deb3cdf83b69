"""The collision branches of the tree: control points, and the arm itself."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rmp_mjx.obstacles import Gap, Obstacles
from rmp_mjx.rmp import RMP, ScalarLeaf
from rmp_mjx.robot.kinematics import ArmState, base_point
from rmp_mjx.robot.model import Robot
from rmp_mjx.robot.point_state import PointRMP, PointState, point_state, pull_to_joints
from rmp_mjx.vec import Vec


def obstacle_branch(
    robot: Robot, arm: ArmState, obstacles: Obstacles, leaf: ScalarLeaf
) -> tuple[RMP, Float[Array, ""]]:
    """Collision leaves between every control point and every obstacle.

    Distances are mapped to points (their RMPs summed over the obstacles, a 3-vector
    and a 3x3 matrix each), points to joints.

    Returns:
        The RMP on the joints, and the least distance to an obstacle [m] (inf if none).
    """
    points = point_state(robot, arm)
    origin = base_point(robot)
    world = points.x + Vec(origin[0], origin[1], origin[2])
    rho = jnp.asarray(robot.points.radius, arm.p.dtype)
    total, clearance = None, jnp.array(jnp.inf, arm.p.dtype)
    for kind in obstacles.kinds:
        gap = kind.gap(world, points.v, rho)
        rmp = _sum_obstacles(gap, leaf)
        total = rmp if total is None else jax.tree.map(jnp.add, total, rmp)
        nearest = jnp.min(jnp.where(gap.active, gap.distance, jnp.inf))
        clearance = jnp.minimum(clearance, nearest)
    if total is None or not robot.points.segment:
        return RMP.zero(robot.n, arm.p.dtype), clearance
    return pull_to_joints(robot, arm, points, total), clearance


def _sum_obstacles(gap: Gap, leaf: ScalarLeaf) -> PointRMP:
    """Pull the leaves back from distances to points and add the obstacles' shares."""
    f, m = leaf.scalar(gap.distance, gap.rate)
    f = jnp.where(gap.active, f - m * gap.curvature, 0.0)
    m = jnp.where(gap.active, m, 0.0)
    n = gap.normal
    mn = n * m
    return PointRMP(
        f=Vec(*(jnp.sum(c * f, axis=0) for c in (n.x, n.y, n.z))),
        xx=jnp.sum(mn.x * n.x, axis=0),
        xy=jnp.sum(mn.x * n.y, axis=0),
        xz=jnp.sum(mn.x * n.z, axis=0),
        yy=jnp.sum(mn.y * n.y, axis=0),
        yz=jnp.sum(mn.y * n.z, axis=0),
        zz=jnp.sum(mn.z * n.z, axis=0),
    )


def self_branch(robot: Robot, arm: ArmState, leaf: ScalarLeaf) -> RMP:
    r"""Collision leaves between the link capsules that can touch.

    The distance of two capsules depends on the joints between them only: with the
    unit force along the gap, :math:`w = (\hat n, p \times \hat n)`,

    .. math::
        \dot d = w \cdot (V_a - V_b), \quad
        \ddot d = w^T S_{ab}\, \ddot q + w \cdot (A_a - A_b) + \dot w \cdot (V_a - V_b).

    Returns:
        RMP on the joints; f (n,), M (n, n).
    """
    pairs = robot.capsules.pairs
    if not pairs:
        return RMP.zero(robot.n, arm.p.dtype)
    segment = np.array(robot.capsules.segment)
    far, near = (np.array(side) for side in zip(*pairs, strict=True))
    ends = _capsule_ends(robot, arm, np.concatenate([far, near]))
    V, A = (_relative(x, segment[far], segment[near]) for x in (arm.V, arm.A))
    radii = np.asarray(robot.capsules.radius)
    positions, velocities = ends

    def unit_wrench(x):
        g, p, norm = _segment_gap(x, len(pairs))
        n = g * (1.0 / norm)
        return jnp.concatenate([n.stack(), p.cross(n).stack()]), norm

    (w, norm), (wdot, _) = jax.jvp(unit_wrench, (positions,), (velocities,))
    rate = jnp.sum(w * V, axis=0)
    curvature = jnp.sum(w * A + wdot * V, axis=0)
    f, m = leaf.scalar(norm - (radii[far] + radii[near]), rate)
    f = f - m * curvature
    joints = np.arange(robot.n)
    between = (joints > segment[near][:, None]) & (joints <= segment[far][:, None])
    rows = jnp.matmul(w.T, arm.S, precision="highest") * between
    return RMP(
        f=jnp.sum(rows * f[:, None], axis=0),
        M=jnp.einsum("pi,p,pj->ij", rows, m, rows, precision="highest"),
    )


def _relative(x: Array, far: np.ndarray, near: np.ndarray) -> Array:
    """Spatial vectors of the far links minus those of the near ones, (6, pairs)."""
    select = np.zeros((x.shape[1], len(far)))
    select[far, np.arange(len(far))] += 1.0
    on_arm = near >= 0
    select[near[on_arm], np.flatnonzero(on_arm)] -= 1.0
    return jnp.matmul(x, jnp.asarray(select, x.dtype), precision="highest")


def _capsule_ends(robot: Robot, arm: ArmState, ids: np.ndarray) -> tuple[Array, Array]:
    """Positions and velocities (3, 2, len(ids)) of the ends, about the base point."""
    capsules, dtype = robot.capsules, arm.p.dtype
    segment = np.array(capsules.segment)[ids]
    local = np.stack(
        [np.asarray(capsules.start)[ids], np.asarray(capsules.end)[ids]], axis=0
    )
    fixed = local - np.asarray(robot.offset[0])
    inner = np.maximum(segment, 0)
    R, p = arm.R[inner], arm.p[inner]
    moved = p.T[:, None] + jnp.einsum(
        "cij,ecj->iec", R, jnp.asarray(local, dtype), precision="highest"
    )
    still = jnp.asarray(np.moveaxis(fixed, 2, 0), dtype)
    x = jnp.where(segment < 0, still, moved)
    V = jnp.where(segment < 0, 0.0, arm.V[:, inner])
    w, v0 = V[3:, None], V[:3, None]
    return x, v0 + jnp.cross(w, x, axis=0)


def _segment_gap(x: Array, k: int) -> tuple[Vec, Vec, Array]:
    """Closest points of k segment pairs: vector from near to far, a point, distance.

    Ericson, "Real-Time Collision Detection" (2005), section 5.1.9, with the clamps
    written as selections so that values and derivatives are finite for parallel and
    degenerate segments.
    """
    a, b = Vec.of(x[:, 0, :k], 0), Vec.of(x[:, 0, k:], 0)
    da, db = Vec.of(x[:, 1, :k], 0) - a, Vec.of(x[:, 1, k:], 0) - b
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
