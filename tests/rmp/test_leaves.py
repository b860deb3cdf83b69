"""What each leaf computes: formulas, safety behaviour, finiteness, PSD metrics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx.math import exp_so3
from rmp_mjx.rmp import leaves
from tests.rmp.outside import Drag, GeodesicBarrier

INF = float("inf")
LOWER = np.array([-1.0, -INF, -2.0, -INF], np.float32)
UPPER = np.array([1.0, INF, INF, 2.0], np.float32)

DISTANCE_LEAVES = {
    "transit": leaves.collision_transit(),
    "near": leaves.collision_near(),
    "unbounded": leaves.Barrier(r=INF, cap=INF),
    "paper": leaves.PaperCollision(),
    "geodesic": GeodesicBarrier(),
    "geodesic_potential": GeodesicBarrier(eps=0.1, alpha=1.0, r=0.3, margin=0.01),
}
JOINT_LEAVES = {
    "barrier": leaves.JointLimitBarrier(LOWER, UPPER),
    "rmpflow": leaves.RMPflowJointLimit(LOWER, UPPER),
}


def _grid(xs, xds):
    x, xd = np.meshgrid(np.asarray(xs, np.float32), np.asarray(xds, np.float32))
    return jnp.asarray(x.ravel()), jnp.asarray(xd.ravel())


# Deep inside, at contact, at the clamps and margins, far away, nothing there.
X, XD = _grid(
    [-1.0, -1e-3, 0.0, 5e-3, 0.01, 0.015, 0.1, 0.2, 0.3, 0.31, 5.0, INF],
    [-1e3, -1.0, -1e-4, 0.0, 1e-4, 1.0, 1e3],
)


@pytest.mark.parametrize("name", DISTANCE_LEAVES)
def test_distance_leaf_is_finite_with_finite_gradients_and_metric_above_zero(name):
    leaf = jax.tree.map(jnp.asarray, DISTANCE_LEAVES[name])
    f, m = leaf.scalar(X, XD)
    assert np.all(np.isfinite(f))
    assert np.all(np.isfinite(m))
    assert np.all(np.asarray(m) >= 0)

    def total(leaf, x, xd):
        f, m = leaf.scalar(x, xd)
        return jnp.sum(f) + jnp.sum(m)

    x, xd = X[jnp.abs(XD) < 10], XD[jnp.abs(XD) < 10]
    grads = jax.jit(jax.grad(total, argnums=(0, 1, 2)))(leaf, x, xd)
    for field in jax.tree.leaves(grads):
        assert np.all(np.isfinite(field)), grads


@pytest.mark.parametrize("name", DISTANCE_LEAVES)
def test_distance_leaf_never_pulls_an_approaching_point_in(name):
    f, m = DISTANCE_LEAVES[name].scalar(X, XD)
    approaching = np.asarray(XD) <= 0
    assert np.all(np.asarray(f)[approaching] >= 0)
    # Far away or not there at all: exactly nothing.
    nothing = np.isinf(np.asarray(X))
    assert not np.any(np.asarray(f)[nothing])
    assert not np.any(np.asarray(m)[nothing])


@pytest.mark.parametrize("name", JOINT_LEAVES)
def test_joint_leaf_is_finite_with_finite_gradients_and_metric_above_zero(name):
    leaf = jax.tree.map(jnp.asarray, JOINT_LEAVES[name])

    @jax.jit
    def probe(leaf, q, qd):
        def total(leaf, q, qd):
            f, m = leaf.scalar(q, qd)
            return jnp.sum(f) + jnp.sum(m)

        return leaf.scalar(q, qd), jax.grad(total, argnums=(0, 1, 2))(leaf, q, qd)

    for q in (-3.0, -1.0, -0.88, 0.0, 0.95, 1.0, 2.0, 2.5):
        for qd in (-2.0, 0.0, 1e-3, 1.0):
            (f, m), grads = probe(leaf, jnp.full(4, q), jnp.full(4, qd))
            assert np.all(np.asarray(m) >= 0)
            for field in jax.tree.leaves((f, m, grads)):
                assert np.all(np.isfinite(field))


@pytest.mark.parametrize("name", JOINT_LEAVES)
def test_unlimited_joint_gets_exactly_nothing(name):
    f, m = JOINT_LEAVES[name].scalar(jnp.full(4, 0.9), jnp.full(4, 3.0))
    assert f[1] == 0.0
    assert m[1] == 0.0
    assert m[0] > 0.0


@pytest.mark.parametrize("name", JOINT_LEAVES)
def test_joint_limit_is_the_same_from_both_sides(name):
    leaf = JOINT_LEAVES[name].replace(lower=-jnp.ones(4), upper=jnp.ones(4))
    q, qd = jnp.asarray([0.3, 0.9, 0.99, -0.5]), jnp.asarray([0.1, 1.0, 0.2, -2.0])
    f, m = leaf.scalar(q, qd)
    f_mirror, m_mirror = leaf.scalar(-q, -qd)
    # 1e-5: float32 rounding of q - lower against upper - q.
    np.testing.assert_allclose(f_mirror, -f, rtol=1e-5)
    np.testing.assert_allclose(m_mirror, m, rtol=1e-5)


def test_call_is_the_elementwise_policy_with_a_diagonal_metric():
    leaf = leaves.collision_transit()
    x, xd = jnp.asarray([0.05, 0.1]), jnp.asarray([-0.3, -0.1])
    rmp, (f, m) = leaf(x, xd), leaf.scalar(x, xd)
    np.testing.assert_array_equal(rmp.f, f)
    np.testing.assert_array_equal(rmp.M, np.diag(m))


def test_barrier_is_its_formula():
    leaf = leaves.Barrier(mu=0.01, eps=0.2, eta=20.0, r=1.0, margin=0.12, cap=1e3)
    x, xd = 0.42, -0.5
    gap = x - 0.12
    m = 0.01 * (1 - gap) ** 2 * (xd**2 + 0.2) / gap**4
    f, metric = leaf.scalar(jnp.asarray(x), jnp.asarray(xd))
    # 1e-5: float32 rounding, the fourth power included.
    np.testing.assert_allclose(metric, m, rtol=1e-5)
    np.testing.assert_allclose(f, m * (20 * 0.5 + xd**2 / gap), rtol=1e-5)
    # Inside the margin: clamped gap, outward spring, capped metric.
    f, metric = leaf.scalar(jnp.asarray(0.02), jnp.asarray(xd))
    np.testing.assert_allclose(metric, 1e3)
    np.testing.assert_allclose(f / metric, 10 + xd**2 / 5e-3 + 100 * 0.1, rtol=1e-5)


def test_barrier_lets_a_leaving_body_go_over_its_release_speed():
    """The metric at rest times exp(-xd / v_out), pushing nowhere; 1e-5: float32."""
    leaf = leaves.Barrier(mu=0.01, eps=0.2, r=1.0, margin=0.12, v_out=3e-3)
    xd = jnp.asarray([0.0, 3e-3, 9e-3, 0.3])
    f, m = leaf.scalar(jnp.full(4, 0.42), xd)
    at_rest = 0.01 * 0.7**2 * 0.2 / 0.3**4
    np.testing.assert_allclose(m[:3], at_rest * np.exp([0.0, -1.0, -3.0]), rtol=1e-5)
    assert m[3] < 1e-30
    assert not np.any(np.asarray(f))


def test_barrier_does_not_throw_a_drifting_body_inwards():
    """One control step of 5 ms under the largest push, drifting off at 1 mm/s.

    Let go at once the body would enter at 0.13 m/s, with nothing to stop it that step.
    """

    def next_speed(leaf, xd=1e-3, push=26.0):
        f, m = leaf.scalar(jnp.asarray(0.01), jnp.asarray(xd))
        return float(xd + 5e-3 * (f - push) / (m + 1.0))

    assert next_speed(leaves.collision_near()) > 0.0
    assert next_speed(leaves.collision_near().replace(v_out=1e-9)) < -0.1


def test_paper_leaf_weighs_and_brakes_an_approach_alone():
    x, xd = jnp.full(2, 0.1), jnp.asarray([-0.5, 0.5])
    f, m = leaves.PaperCollision(eta=2.0).scalar(x, xd)
    # 1e-5: float32 rounding of the fourth power.
    np.testing.assert_allclose(m, [2500.0, 0.0], rtol=1e-5)
    np.testing.assert_allclose(f, [2500.0, 0.0], rtol=1e-5)


def test_bare_geodesic_leaf_obeys_xdd_equals_xd_squared_over_x():
    x, xd = _grid([0.05, 0.1, 0.7], [-2.0, -0.3, -0.05])
    f, m = GeodesicBarrier(eta=0.0, cap=INF).scalar(x, xd)
    # 1e-5: float32 rounding.
    np.testing.assert_allclose(f / m, xd**2 / x, rtol=1e-5)


def test_gds_metric_and_curvature_are_derivatives_of_its_energy_metric(x64):
    """M = g + xd g_xd / 2 and xi = xd^2 g_x / 2, by autodiff of g."""
    leaf = GeodesicBarrier(mu=0.7, eps=0.1, eta=0.0, r=0.5, margin=0.02, cap=INF)

    def g(x, xd):
        gap = x - 0.02
        w = 0.7 * (1 - gap / 0.5) ** 2 / gap**4
        return (0.1 + jnp.minimum(xd, 0.0) ** 2) * w

    for x, xd in [(0.1, -0.4), (0.3, -1.0), (0.2, 0.6)]:
        f, m = leaf.scalar(jnp.asarray(x), jnp.asarray(xd))
        # 1e-12: float64 rounding.
        np.testing.assert_allclose(
            m, g(x, xd) + 0.5 * xd * jax.grad(g, 1)(x, xd), rtol=1e-12
        )
        np.testing.assert_allclose(f, -0.5 * xd**2 * jax.grad(g)(x, xd), rtol=1e-12)


def test_gds_cap_scales_force_and_metric_together():
    x, xd = jnp.asarray(0.02), jnp.asarray(-1.0)
    f, m = GeodesicBarrier(eta=3.0, cap=INF).scalar(x, xd)
    f_cap, m_cap = GeodesicBarrier(eta=3.0, cap=100.0).scalar(x, xd)
    # 1e-6: float32 rounding.
    np.testing.assert_allclose(m_cap, 100.0, rtol=1e-6)
    np.testing.assert_allclose(f_cap / m_cap, f / m, rtol=1e-6)


def _push(leaf, distance=0.2, push=15.0, dt=2e-3, seconds=10.0):
    """Least distance and speed at contact of a unit mass pushed at a wall.

    The push is the largest of the action range: kp 300 times 5 cm, critically damped.
    """

    @jax.jit
    def run(leaf):
        def step(state, _):
            x, xd = state
            f, m = leaf.scalar(x, xd)
            xdd = (f - push - 2 * np.sqrt(300.0) * xd) / (m + 1.0)
            xd = xd + dt * xdd
            return (x + dt * xd, xd), x

        start = (jnp.asarray(distance), jnp.asarray(0.0))
        return jax.lax.scan(step, start, length=int(seconds / dt))[1]

    return float(jnp.min(run(leaf)))


@pytest.mark.parametrize("name", ["transit", "near"])
def test_barrier_stops_a_steadily_pushed_mass_before_contact(name):
    assert _push(DISTANCE_LEAVES[name]) > 0.0


def test_pushed_mass_creeps_through_the_papers_leaf():
    """Its metric vanishes with the speed: in time a steady push always wins."""
    assert _push(DISTANCE_LEAVES["paper"], seconds=60.0) < 0.0


def test_pushed_mass_goes_through_without_a_barrier():
    assert _push(Drag(0.0, 0.0)) < -1.0


def _push_joint(limit, push=15.0, dt=2e-3):
    """Least distance to the upper limit of a unit-inertia joint pushed towards it."""

    def step(state, _):
        q, qd = state
        f, m = limit.scalar(q, qd)
        qdd = (f + push - 2 * np.sqrt(300.0) * qd) / (m + 1.0)
        qd = qd + dt * qdd
        return (q + dt * qd, qd), 1.0 - q

    start = (jnp.asarray(0.0), jnp.asarray(0.0))
    return float(jnp.min(jax.lax.scan(step, start, length=2500)[1]))


def test_joint_barrier_keeps_a_pushed_joint_clear_of_the_last_tenth_of_a_radian():
    limit = leaves.JointLimitBarrier(jnp.asarray(-1.0), jnp.asarray(1.0))
    assert _push_joint(limit) > 0.1


def test_rmpflow_joint_limit_is_a_brake_and_not_a_wall():
    """At rest the metric is lambda everywhere; only speed towards the end raises it."""
    leaf = leaves.RMPflowJointLimit(-jnp.ones(3), jnp.ones(3))
    q = jnp.asarray([0.0, 0.5, 0.99])
    _, m = leaf.scalar(q, jnp.zeros(3))
    np.testing.assert_allclose(m, 0.01, rtol=1e-6)
    _, m_fast = leaf.scalar(q, jnp.ones(3))
    assert m_fast[2] > 10 * m_fast[0]


def test_rmpflow_joint_limit_curvature_is_the_derivative_of_its_metric(x64):
    leaf = leaves.RMPflowJointLimit(
        -jnp.ones(()), jnp.ones(()), gamma_p=0.0, gamma_d=0.0
    )
    q, qd, h = 0.6, 0.15, 1e-6
    f, _ = leaf.scalar(jnp.asarray(q), jnp.asarray(qd))
    metric = [leaf.scalar(jnp.asarray(q + s), jnp.asarray(qd))[1] for s in (h, -h)]
    slope = (metric[0] - metric[1]) / (2 * h)
    # 1e-7 relative: h^2 truncation and 1e-16 / h rounding.
    np.testing.assert_allclose(f, -0.5 * slope * qd**2, rtol=1e-7)


def test_position_attractor_attracts_and_is_critically_damped():
    target = jnp.asarray([1.0, 2.0, 3.0])
    kp = jnp.asarray([4.0, 9.0, 16.0])
    rmp = leaves.PositionAttractor(target, kp, weight=2.0)(jnp.zeros(3), jnp.ones(3))
    np.testing.assert_allclose(rmp.f, 2.0 * (kp * target - 2 * jnp.sqrt(kp)), rtol=1e-6)
    np.testing.assert_array_equal(rmp.M, 2.0 * np.eye(3))
    given = leaves.PositionAttractor(target, kp, kd=1.0)(jnp.zeros(3), jnp.ones(3))
    np.testing.assert_allclose(given.f, kp * target - 1.0, rtol=1e-6)


def test_orientation_attractor_turns_towards_the_target():
    R_des = exp_so3(jnp.asarray([0.0, 0.0, 0.5]))
    rmp = leaves.orientation_attractor(jnp.eye(3), jnp.zeros(3), R_des, 100.0)
    # 1e-5: float32 rounding.
    np.testing.assert_allclose(rmp.f, [0.0, 0.0, 100 * np.sin(0.5)], rtol=1e-5)


@pytest.mark.parametrize("R", [np.eye(3), np.diag([1.0, -1.0, -1.0])])
def test_orientation_leaf_has_finite_gradients_at_zero_error_and_at_a_half_turn(R):
    def total(R):
        leaf = leaves.OrientationAttractor(jnp.eye(3), 50.0)
        rmp = leaf(R.reshape(9), jnp.zeros(9))
        return jnp.sum(rmp.f) + jnp.sum(rmp.M)

    assert np.all(np.isfinite(jax.grad(total)(jnp.asarray(R, jnp.float32))))


def test_posture_uses_the_inertia_as_its_metric_when_given():
    leaf = leaves.Posture(jnp.asarray([1.0, -1.0]), kq=4.0, weight=0.5)
    q, qd = jnp.zeros(2), jnp.asarray([0.5, 0.0])
    a = np.array([4.0 - 2.0, -4.0])
    np.testing.assert_allclose(leaf.acceleration(q, qd), a, rtol=1e-6)
    np.testing.assert_allclose(leaf(q, qd).f, 0.5 * a, rtol=1e-6)
    Mq = jnp.asarray([[2.0, 0.3], [0.3, 1.0]])
    rmp = leaf(q, qd, Mq)
    np.testing.assert_allclose(rmp.M, 0.5 * Mq, rtol=1e-6)
    np.testing.assert_allclose(rmp.f, 0.5 * Mq @ a, rtol=1e-6)


def test_vector_leaf_metrics_are_symmetric_and_positive():
    rng = np.random.default_rng(0)
    R = exp_so3(jnp.asarray([0.4, -0.2, 0.9]))
    G = rng.normal(size=(3, 3)).astype(np.float32)
    x, xd = jnp.asarray(G[0]), jnp.asarray(G[1])
    rmps = [
        leaves.PositionAttractor(x, 100.0)(x, xd),
        leaves.Posture(x)(x, xd, jnp.asarray(G @ G.T)),
        leaves.OrientationAttractor(R, 50.0)(R.reshape(9), jnp.zeros(9)),
    ]
    for rmp in rmps:
        np.testing.assert_allclose(rmp.M, rmp.M.T, atol=1e-6)
        # 1e-6: rounding of the zero eigenvalues.
        assert np.linalg.eigvalsh(rmp.M).min() > -1e-6


LEAVES = {
    "near": leaves.collision_near(),
    "transit": leaves.collision_transit(),
    "joint limit": leaves.joint_limit_barrier(),
    "strong": leaves.Barrier(mu=0.7, eps=0.1, eta=3.0, r=0.5, cap=10.0, v_out=0.2),
}


def documented(p, d, rate):
    """Force and metric by the page's formula."""
    x = np.maximum(d - p.margin, p.x_min)
    v = np.minimum(rate, 0.0)
    h = np.exp(-np.maximum(rate, 0.0) / p.v_out)
    m = h * np.minimum(p.mu * (1 - x / p.r) ** 2 * (v**2 + p.eps) / x**4, p.cap)
    a = -p.eta * v + v**2 / x + p.k_out * np.maximum(p.margin - d, 0.0)
    inside = x < p.r
    return np.where(inside, m * a, 0.0), np.where(inside, m, 0.0)


@pytest.mark.parametrize("name", LEAVES)
def test_the_barrier_is_its_documented_formula(name):
    """1e-12, relative or of the unit: float64, other orders of the operations."""
    leaf = LEAVES[name]
    d = np.concatenate([np.linspace(-0.1, 0.7, 161), [leaf.margin, leaf.margin + 5e-3]])
    rate = np.concatenate([np.linspace(-2.0, 0.02, 102), [-1e-3, 0.0, 1e-3]])
    d, rate = (x.ravel() for x in np.meshgrid(d, rate))
    with jax.enable_x64(True):
        f, m = jax.device_get(jax.jit(leaf.scalar)(d, rate))
    assert m.dtype == np.float64
    expected_f, expected_m = documented(leaf, d, rate)
    np.testing.assert_allclose(m, expected_m, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(f, expected_f, rtol=1e-12, atol=1e-12)
    # Every part of the formula is met: cap, fade, range, margin.
    assert (m == leaf.cap).any() and (m[rate > 0] > 0).any()
    assert (m == 0).any() and (f[d < leaf.margin] > 0).any()


@pytest.mark.parametrize("name", LEAVES)
def test_the_metric_fades_over_v_out_while_the_body_leaves(name):
    """A factor of exp(-1) for each v_out; it does not end at rest."""
    leaf = LEAVES[name]
    d = np.full(4, leaf.margin + 0.5 * leaf.r)
    with jax.enable_x64(True):
        f, m = jax.device_get(jax.jit(leaf.scalar)(d, leaf.v_out * np.arange(4.0)))
    np.testing.assert_allclose(m / m[0], np.exp(-np.arange(4.0)), rtol=1e-12)
    np.testing.assert_array_equal(f, 0.0)
