"""The collision branches against measured distances, and degenerate segments.

A branch is its leaves, at the distances and their rates, pulled back to the joints:
$f = \\sum g (f_d - m \\ddot d)$, $M = \\sum m g g^T$, with the distance's gradient g by
the joints and its acceleration on the line that the joints are on.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rmp_mjx import Obstacles
from rmp_mjx.control.avoidance import (
    obstacle_branch,
    obstacle_gaps,
    per_link,
    segment_gap,
    self_branch,
    self_gaps,
)
from rmp_mjx.control.tree import _segment_distance
from rmp_mjx.rmp.leaves import Barrier
from rmp_mjx.robot.configurations import capsule_gaps, random_configurations
from rmp_mjx.robot.kinematics import arm_state, base_point, forward_kinematics
from rmp_mjx.robot.point_state import point_state
from rmp_mjx.vec import Vec
from tests.oracles import Measured, along, in_float64


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


LEAF = Barrier(mu=0.01, r=3.0, cap=1e3, v_out=3.0)
CENTRE, MOVING = (
    np.array([[0.1, 0.3, 0.9], [0.6, 0.2, 0.4]]),
    np.array([0.2, 0.1, -0.3]),
)
RADIUS, WALL = np.array([0.1, 0.05]), np.array([0.0, 0.6, 0.8])
NEAR = 0.4


def scene():
    """Two spheres, one moves and the hand may touch it; two walls, one is off."""
    slots = Obstacles.empty(spheres=3, planes=2)
    slots = slots.with_spheres(
        CENTRE, RADIUS, [np.zeros(3), MOVING], hand_may_touch=[False, True]
    )
    return slots.with_planes([[0.0, -1.0, 0.0]], WALL[None], -0.5 * MOVING[None])


@pytest.fixture(scope="module")
def run(bent):
    """`run(q, qd, w)`: gaps and branches, in float64."""

    def both(q, qd, w):
        arm, obstacles = arm_state(bent, q, qd), scene()
        mu = LEAF.replace(mu=per_link(bent, [0.01, 0.02, 0.03, 0.04]))
        leaf = {"spheres": mu, "planes": LEAF.replace(eta=3.0)}
        return {
            "self gaps": self_gaps(bent, arm),
            "self": self_branch(bent, arm, LEAF),
            "self pushed": self_branch(bent, arm, LEAF, w),
            "gaps": obstacle_gaps(bent, point_state(bent, arm), obstacles),
            "obstacles": obstacle_branch(bent, arm, obstacles, leaf),
            "pushed": obstacle_branch(bent, arm, obstacles, leaf, w, NEAR),
            "walls": obstacle_branch(bent, arm, obstacles, leaf | {"spheres": None}),
        }

    return in_float64(both)


@pytest.fixture(scope="module")
def states(bent):
    """20 states in which no watched pair touches, and accelerations by contacts."""
    rng = np.random.default_rng(0)
    q = random_configurations(bent, 400)
    q = q[capsule_gaps(bent, q, bent.capsules.pairs).min(axis=1) > 0.02][:20]
    assert len(q) == 20
    return q, rng.normal(size=q.shape), 5.0 * rng.normal(size=q.shape)


def pulled_back(leaf, distance, motion, push=None):
    """The RMP on the joints of leaves at distances (k,), by NumPy."""
    rate, acceleration, gradient = motion
    with jax.enable_x64(True):
        at = jnp.asarray(distance), jnp.asarray(rate)
        if push is None:
            f, m = leaf.scalar(*at)
        else:
            f, m = leaf.scalar_against(*at, jnp.asarray(gradient @ push))
    f, m = np.asarray(f), np.asarray(m)
    return gradient.T @ (f - m * acceleration), gradient.T @ (m[:, None] * gradient)


def assert_same(rmp, expected):
    """1e-5 of the largest entry: second differences of distances."""
    for found, theirs in zip((rmp.f, rmp.M), expected, strict=True):
        np.testing.assert_allclose(found, theirs, atol=1e-5 * np.abs(theirs).max())


def test_self_gaps_are_distances_and_their_derivatives(bent, run, states):
    """Distances by MuJoCo C, 1e-9 m; rates 1e-6 of 1 m/s, accelerations 1e-5 of 30."""
    pairs, measured = bent.capsules.pairs, Measured(bent)
    assert any(bent.capsules.segment[near] < 0 for _, near in pairs)
    assert any(bent.capsules.segment[near] >= 0 for _, near in pairs)

    def distances(q, _):
        return capsule_gaps(bent, q[None], pairs)[0]

    for q, qd, w in zip(*states, strict=True):
        out = run(q, qd, w)
        distance, rate, curvature, rows = out["self gaps"]
        motion = along(distances, q, qd)
        np.testing.assert_allclose(distance, measured.gaps(q, pairs), atol=1e-9)
        np.testing.assert_allclose(rate, motion[0], rtol=0, atol=1e-6)
        np.testing.assert_allclose(curvature, motion[1], rtol=0, atol=3e-4)
        np.testing.assert_allclose(rows, motion[2], rtol=0, atol=1e-6)
        assert_same(out["self"], pulled_back(LEAF, distance, motion))
        assert_same(out["self pushed"], pulled_back(LEAF, distance, motion, w))


def test_obstacle_branches_are_leaves_at_the_distances_of_the_points(bent, run, states):
    measured, radius = Measured(bent), bent.points.radius
    segment = np.array(bent.points.segment)
    hand, size = segment == 3, len(radius)
    mu = 0.01 * (1 + np.concatenate([segment, segment[~hand]]))

    def distances(q, t):
        x = measured.points(q)
        moved = CENTRE + t * np.stack([np.zeros(3), MOVING])
        balls = np.linalg.norm(x - moved[:, None], axis=2) - RADIUS[:, None]
        point = [0.0, -1.0, 0.0] - 0.5 * t * MOVING
        return np.concatenate([*(balls - radius), (x - point) @ WALL - radius])

    avoided = np.concatenate([np.ones(size, bool), ~hand, np.ones(size, bool)])
    for q, qd, w in zip(*states, strict=True):
        out, distance = run(q, qd, w), distances(q, 0.0)
        motion = along(distances, q, qd)
        for kind, part in (
            ("spheres", slice(0, 2 * size)),
            ("planes", slice(-size, None)),
        ):
            gap = out["gaps"][kind]
            used = gap.distance[: 2 if kind == "spheres" else 1]
            np.testing.assert_allclose(used.ravel(), distance[part], atol=1e-9)
            rates = gap.rate[: len(used)].ravel()
            np.testing.assert_allclose(rates, motion[0][part], rtol=0, atol=1e-6)
            np.testing.assert_array_equal(
                gap.active[: len(used)].ravel(), avoided[part]
            )
            assert not gap.active[len(used) :].any()
        some = [x[avoided] for x in motion]
        balls = slice(None, -size)
        for name, push in (("obstacles", None), ("pushed", w)):
            rmp, around = out[name]
            shares = (
                (
                    LEAF.replace(mu=mu),
                    distance[avoided][balls],
                    [x[balls] for x in some],
                ),
                (LEAF.replace(eta=3.0), distance[-size:], [x[-size:] for x in some]),
            )
            parts = [pulled_back(*share, push) for share in shares]
            assert_same(rmp, [a + b for a, b in zip(*parts, strict=True)])
            least = distance[avoided][balls].min(), distance[-size:].min()
            found = around.clearance["spheres"], around.clearance["planes"]
            np.testing.assert_allclose(found, least, atol=1e-9)
            if push is None:
                assert around.pressed == 0.0
                assert_same(out["walls"][0], parts[1])
                continue
            close = distance[avoided] < NEAR
            pressed = np.max(-(some[2] @ w)[close], initial=0.0)
            np.testing.assert_allclose(around.pressed, pressed, atol=1e-5)


def test_a_value_for_every_link_is_one_for_its_points(bent):
    values = per_link(bent, [1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(values, 1.0 + np.array(bent.points.segment))
    with pytest.raises(ValueError, match="each of the 4 links, got shape"):
        per_link(bent, [1.0, 2.0, 3.0])
