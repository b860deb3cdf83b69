"""Obstacles: distances against MuJoCo C, derivatives against the motion itself."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rmp_mjx.obstacles import Obstacles
from rmp_mjx.vec import Vec

KINDS = ("spheres", "planes", "capsules", "boxes")
RHO = 0.02
"""Radius of the control points in these tests [m]."""


def _rotations(rng, k):
    Q = np.linalg.qr(rng.normal(size=(k, 3, 3)))[0]
    return Q * np.linalg.det(Q)[:, None, None]


def _scene(k=6, moving=True):
    """k obstacles of each kind about the origin, and the arguments they came from."""
    rng = np.random.default_rng(0)
    speed = 1.0 if moving else 0.0

    def some(scale=0.3):
        return rng.normal(scale=scale, size=(k, 3))

    args = {
        "spheres": (some(), rng.uniform(0.05, 0.2, k), speed * some(1.0)),
        "planes": (some(), some(1.0), speed * some(1.0)),
        "capsules": (
            *(some(), some(), rng.uniform(0.05, 0.1, k)),
            *(speed * some(1.0), speed * some(1.0)),
        ),
        "boxes": (
            *(some(), rng.uniform(0.05, 0.2, (k, 3)), _rotations(rng, k)),
            *(rng.uniform(0.0, 0.05, k), speed * some(1.0), speed * some(1.0)),
        ),
    }
    slots = Obstacles.empty(spheres=k, planes=k, capsules=k, boxes=k)
    for kind in KINDS:
        slots = getattr(slots, f"with_{kind}")(*args[kind])
    return slots, args


@pytest.fixture(scope="module")
def scene():
    with jax.enable_x64(True):
        return _scene()


@pytest.fixture(scope="module")
def points():
    """300 points and velocities, some of them inside obstacles."""
    rng = np.random.default_rng(1)
    return rng.normal(scale=0.4, size=(300, 3)), rng.normal(size=(300, 3))


@jax.jit
def _gaps(slots, x, v):
    rho = jnp.full(x.shape[0], RHO)
    hand = np.arange(x.shape[0]) % 2 == 0
    return tuple(slots.gaps(Vec.of(x), Vec.of(v), rho, hand).values())


@pytest.fixture(scope="module")
def gaps(scene, points):
    with jax.enable_x64(True):
        found = jax.device_get(_gaps(scene[0], *points))
    return dict(zip(KINDS, found, strict=True))


def _mujoco_geom(kind, args, i):
    """The obstacle as a MuJoCo geom, and the radius that MuJoCo's geom leaves out."""
    if kind == "spheres":
        (x, y, z), r = args[0][i], args[1][i]
        return f'<geom name="o" size="{r}" pos="{x} {y} {z}"/>', 0.0
    if kind == "capsules":
        ends = " ".join(str(c) for c in (*args[0][i], *args[1][i]))
        return f'<geom name="o" type="capsule" fromto="{ends}" size="{args[2][i]}"/>', 0
    if kind == "planes":
        x, y, z = args[0][i]
        axis = " ".join(str(c) for c in args[1][i])
        return (
            f'<geom name="o" type="plane" size="9 9 1" pos="{x} {y} {z}" '
            f'zaxis="{axis}"/>',
            0.0,
        )
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, args[2][i].ravel())
    (x, y, z), (a, b, c) = args[0][i], args[1][i]
    w = " ".join(str(c) for c in quat)
    return (
        f'<geom name="o" type="box" size="{a} {b} {c}" pos="{x} {y} {z}" quat="{w}"/>',
        args[3][i],
    )


@pytest.mark.parametrize("kind", KINDS)
def test_distance_is_mujocos(kind, scene, points, gaps):
    """mj_geomDistance of a small sphere at each point; outside the core.

    1e-9 m; 1e-5 m to boxes, whose distances MuJoCo finds by iteration. Rounded
    edges make a box's signed distance differ once the *core* is entered: MuJoCo's box
    has no rounding, so those points are compared below instead.
    """
    args = scene[1][kind]
    for i in range(3):
        geom, rounding = _mujoco_geom(kind, args, i)
        model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><worldbody>{geom}<body mocap="true" name="ball">
            <geom name="ball" size="{RHO}"/></body></worldbody></mujoco>"""
        )
        data = mujoco.MjData(model)
        compared = 0
        for x, ours in zip(points[0], gaps[kind].distance[i], strict=True):
            if kind == "boxes" and ours + RHO + rounding <= 1e-3:
                continue
            data.mocap_pos[0] = x
            mujoco.mj_kinematics(model, data)
            theirs = mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None)
            tolerance = 1e-5 if kind == "boxes" else 1e-9
            assert abs(ours - (theirs - rounding)) < tolerance
            compared += 1
        assert compared > 200


def test_inside_a_box_the_distance_is_the_depth_below_the_nearest_face(points):
    with jax.enable_x64(True):
        slots = Obstacles.empty(boxes=1).with_boxes([[0, 0, 0]], [[0.3, 0.2, 0.1]])
        x = np.random.default_rng(0).uniform(-1, 1, (300, 3)) * [0.3, 0.2, 0.1]
        (gap,) = jax.device_get(_gaps(slots, x, 0.0 * x))
    depth = np.max(np.abs(x) - [0.3, 0.2, 0.1], axis=1)
    np.testing.assert_allclose(gap.distance[0], depth - RHO, atol=1e-15)


def _stack(n):
    """A normal in NumPy, to keep float64: (6, 300, 3)."""
    return np.stack([np.broadcast_to(c, (6, 300)) for c in (n.x, n.y, n.z)], axis=-1)


@pytest.mark.parametrize("kind", KINDS)
def test_normals_are_unit_vectors(kind, gaps):
    norm = np.linalg.norm(_stack(gaps[kind].normal), axis=-1)
    np.testing.assert_allclose(norm, 1.0, rtol=1e-12)


def _moved(args, kind, t):
    """The obstacles of one kind t seconds from now, by their definition."""
    slots = Obstacles.empty(**{kind: 6})
    if kind in ("spheres", "planes"):
        args = (args[0] + t * args[2], *args[1:])
        return getattr(slots, f"with_{kind}")(*args)
    velocity, spin = args[-2:]
    K = np.cross(spin[:, None], -np.eye(3))
    turn = (
        np.eye(3)[None] + t * K + 0.5 * t**2 * (K @ K)
    )  # exact in two derivatives at t = 0
    if kind == "capsules":
        middle, arm = 0.5 * (args[0] + args[1]), 0.5 * (args[1] - args[0])
        middle = middle + t * velocity
        arm = jnp.einsum("kij,kj->ki", turn, arm)
        return slots.with_capsules(middle - arm, middle + arm, args[2])
    R = jnp.einsum("kij,kjl->kil", turn, args[2])
    return slots.with_boxes(args[0] + t * velocity, args[1], R, args[3])


@pytest.mark.parametrize("kind", KINDS)
def test_rate_normal_and_curvature_are_derivatives_of_the_distance(
    kind, scene, points, gaps
):
    """Autodiff of the distance along the motion of point and obstacle, rotation too.

    At constant velocity of the point, so that the distance's second derivative is the
    curvature alone. 1e-8 of the largest: derivatives of a norm near zero amplify.
    """
    args, (x, v) = scene[1][kind], points

    def distance(x, t):
        rho = jnp.full(x.shape[0], RHO)
        hand = np.zeros(x.shape[0], bool)
        return (
            _moved(args, kind, t).gaps(Vec.of(x), Vec.of(v), rho, hand)[kind].distance
        )

    def rate(t):
        return jax.jvp(lambda t: distance(x + t * v, t), (t,), (1.0,))[1]

    @jax.jit
    def derivatives():
        first, second = jax.jvp(rate, (0.0,), (1.0,))
        gradient = jax.vjp(lambda y: distance(y, 0.0).sum(1), jnp.asarray(x))[1]
        normals = jax.vmap(lambda row: gradient(row)[0])(jnp.eye(6))
        return first, second, normals

    with jax.enable_x64(True):
        x, v = jnp.asarray(x), jnp.asarray(v)
        first, second, normals = jax.device_get(derivatives())
    gap = gaps[kind]
    for ours, expected in (
        (gap.rate, first),
        (gap.curvature, second),
        (_stack(gap.normal), normals),
    ):
        scale = np.abs(expected).max() + 1.0
        np.testing.assert_allclose(ours, expected, rtol=0.0, atol=1e-8 * scale)


def test_unused_slots_are_inactive_and_finite(points):
    for fill in (False, True):
        slots = Obstacles.empty(spheres=3, planes=3, capsules=3, boxes=3)
        if fill:
            slots = slots.with_spheres([[0, 0, 1.0]], 0.1).with_planes(
                [[0, 0, 0]], [[0, 0, 2.0]]
            )
        x, v = (p.astype(np.float32) for p in points)
        for kind, gap in zip(KINDS, _gaps(slots, x, v), strict=True):
            used = fill and kind in ("spheres", "planes")
            assert gap.active.all(axis=1).tolist() == [used, False, False]
            assert gap.active.any(axis=1).tolist() == [used, False, False]
            assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gap))


@pytest.mark.parametrize("kind", KINDS)
def test_the_hand_may_touch_what_it_is_told_and_the_other_links_may_not(
    kind, scene, points
):
    """Even points are the hand's, which may touch the first obstacle alone."""
    touch = np.arange(6) == 0
    with jax.enable_x64(True):
        slots = getattr(scene[0], f"with_{kind}")(*scene[1][kind], hand_may_touch=touch)
        gap = dict(zip(KINDS, _gaps(slots, *points), strict=True))[kind]
    active = np.asarray(gap.active)
    assert active[1:].all()
    assert active[0, 1::2].all()
    assert not active[0, ::2].any()


def test_at_the_core_everything_is_finite_with_a_unit_normal():
    """A point at a sphere's centre, on a capsule's axis, at a box's centre."""
    slots = (
        Obstacles.empty(spheres=1, capsules=1, boxes=1)
        .with_spheres([[0, 0, 0]], 0.1)
        .with_capsules([[0, 0, -1]], [[0, 0, 1]], 0.1)
        .with_boxes([[0, 0, 0]], [[0.1, 0.1, 0.1]])
    )
    x, v = jnp.zeros((1, 3)), jnp.ones((1, 3))
    for gap in _gaps(slots, x, v):
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gap))
        np.testing.assert_allclose(gap.normal @ gap.normal, 1.0, atol=1e-6)

    def total(x):
        return sum(
            jnp.sum(g.distance + g.rate + g.curvature) for g in _gaps(slots, x, v)
        )

    assert np.isfinite(jax.grad(total)(x)).all()


def test_a_degenerate_capsule_is_a_sphere(points):
    with jax.enable_x64(True):
        ball = Obstacles.empty(spheres=1).with_spheres([[0.1, 0, 0]], 0.1)
        stub = Obstacles.empty(capsules=1).with_capsules(
            [[0.1, 0, 0]], [[0.1, 0, 0]], 0.1
        )
        (a,), (b,) = _gaps(ball, *points), _gaps(stub, *points)
    np.testing.assert_allclose(a.distance, b.distance, atol=1e-14)
    np.testing.assert_allclose(a.curvature, b.curvature, atol=1e-10)


def test_kinds_without_slots_are_left_out():
    assert Obstacles.empty().kinds == ()
    assert len(Obstacles.empty(planes=2).kinds) == 1


def test_filling_works_under_jit_and_keeps_the_shapes():
    slots = Obstacles.empty(spheres=4)
    filled = jax.jit(lambda c, r: slots.with_spheres(c, r))(jnp.ones((2, 3)), 0.2)
    assert jax.tree.map(jnp.shape, filled) == jax.tree.map(jnp.shape, slots)
    assert filled.spheres.active.tolist() == [True, True, False, False]
    np.testing.assert_allclose(filled.spheres.radius[:2], 0.2)


def test_filling_again_replaces():
    slots = Obstacles.empty(spheres=3).with_spheres(np.ones((3, 3)), 0.2)
    assert slots.with_spheres(np.ones((1, 3)), 0.1).spheres.active.sum() == 1
    assert slots.with_spheres(np.ones((0, 3)), 0.1).spheres.active.sum() == 0


@pytest.mark.parametrize("radius", [0.0, -0.1, float("nan"), float("inf")])
def test_a_radius_must_be_positive_and_finite(radius):
    slots = Obstacles.empty(spheres=1, capsules=1, boxes=1)
    with pytest.raises(ValueError, match="sphere radii must be positive and finite"):
        slots.with_spheres([[0, 0, 0]], [radius])
    with pytest.raises(ValueError, match="capsule radii must be positive and finite"):
        slots.with_capsules([[0, 0, 0]], [[0, 0, 1]], [radius])
    with pytest.raises(ValueError, match="half sizes must be positive and finite"):
        slots.with_boxes([[0, 0, 0]], [[0.1, radius, 0.1]])


def test_too_many_obstacles_say_how_many_slots_to_ask_for():
    with pytest.raises(ValueError, match=r"2 spheres do not fit in 1 slots.*spheres=2"):
        Obstacles.empty(spheres=1).with_spheres(np.zeros((2, 3)), 0.1)
    with pytest.raises(ValueError, match=r"1 planes do not fit in 0 slots.*planes=1"):
        Obstacles.empty().with_planes([[0, 0, 0]], [[0, 0, 1]])
