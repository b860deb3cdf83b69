"""Self-collision distances against MuJoCo C, and degenerate segments."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rmp_mjx.control.avoidance import segment_gap
from rmp_mjx.control.tree import _segment_distance
from rmp_mjx.robot.kinematics import base_point, forward_kinematics
from rmp_mjx.vec import Vec


@jax.jit
def _distance(far, near):
    """Distance of segments (k, 2, 3), by the closed form and by the tree's own."""
    ends = jnp.concatenate([far[:, 0], far[:, 1], near[:, 0], near[:, 1]])
    gap, _, norm = segment_gap(Vec.of(ends))
    tree = jax.vmap(_segment_distance)(far[:, 0], far[:, 1], near[:, 0], near[:, 1])
    return norm, gap.stack(-1), tree


def test_capsule_distances_of_the_arm_are_mujocos(robot):
    """Every watched pair at 200 random configurations, float64, 1e-9 m."""
    capsules, model = robot.capsules, robot.mj_model
    data = mujoco.MjData(model)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (200, 7)) + np.pi
    with jax.enable_x64(True):
        fk = jax.jit(jax.vmap(forward_kinematics, in_axes=(None, 0)))
        p, R = jax.device_get(fk(robot, q))
        base = np.asarray(base_point(robot))
    segment = np.array(capsules.segment)
    ends = np.stack([capsules.start, capsules.end], axis=1)  # (c, 2, 3)
    moved = np.einsum("kijc,cej->kcei", R[..., segment], ends)
    moved += np.moveaxis(p[..., segment], 1, 2)[:, :, None] + base
    world = np.where((segment < 0)[:, None, None], ends, moved)
    far, near = (list(ids) for ids in zip(*capsules.pairs, strict=True))
    with jax.enable_x64(True):
        norm, _, tree = jax.device_get(
            _distance(world[:, far].reshape(-1, 2, 3), world[:, near].reshape(-1, 2, 3))
        )
    ours = norm.reshape(200, -1) - (capsules.radius[far] + capsules.radius[near])
    np.testing.assert_allclose(norm, tree, rtol=0.0, atol=1e-9)
    for k in range(200):
        data.qpos[:] = q[k]
        mujoco.mj_kinematics(model, data)
        for i, pair in enumerate(capsules.pairs):
            a, b = (model.geom(capsules.geom[c]).id for c in pair)
            theirs = mujoco.mj_geomDistance(model, data, a, b, 5.0, None)
            assert abs(ours[k, i] - theirs) < 1e-9


NULL, X, Y, Z = np.zeros(3), *np.eye(3)
DEGENERATE = {
    "parallel side by side": ((NULL, X), (Y, X + Y), 1.0),
    "parallel, overlapping in part": ((NULL, X), (0.7 * X + Y, 2 * X + Y), 1.0),
    "parallel, one behind the other": ((NULL, X), (2 * X, 3 * X), 1.0),
    "opposite directions": ((NULL, X), (3 * X, 2 * X), 1.0),
    "crossing": ((-X, X), (-Y, Y), 0.0),
    "crossing above": ((-X, X), (Z - Y, Z + Y), 1.0),
    "the same": ((NULL, X), (NULL, X), 0.0),
    "end to side": ((NULL, X), (0.5 * X + Y, 0.5 * X + 2 * Y), 1.0),
    "end to end": ((NULL, X), (X + Y, X + 2 * Y), 1.0),
    "a point and a segment": ((Y, Y), (-X, X), 1.0),
    "a segment and a point": ((-X, X), (2 * X, 2 * X), 1.0),
    "two points": ((NULL, NULL), (Z, Z), 1.0),
    "one point twice": ((NULL, NULL), (NULL, NULL), 0.0),
}


@pytest.mark.parametrize(
    ("far", "near", "expected"), DEGENERATE.values(), ids=DEGENERATE
)
def test_degenerate_segments_have_the_right_distance_and_finite_derivatives(
    far, near, expected
):
    far, near = (jnp.asarray([s], jnp.float32) for s in (far, near))
    (norm, gap, _), rates = _with_rates(far, near)
    np.testing.assert_allclose(norm[0], expected, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(gap[0]), expected, atol=1e-6)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(rates))


@jax.jit
def _with_rates(far, near):
    ones = (jnp.ones_like(far), -jnp.ones_like(near))
    return jax.jvp(_distance, (far, near), ones)
