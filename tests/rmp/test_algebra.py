"""Laws of the RMP algebra, by hypothesis; every law is exact up to rounding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmp_mjx.rmp.algebra import RMP, pullback, resolve

SEEDS = st.integers(0, 2**32 - 1)
LAW = settings(max_examples=50, deadline=None)
# Entries are of order one and sums have at most 5 terms: 1e-12 is thousands of float64
# roundings.
ATOL = 1e-12


def _rmp(rng, m):
    G = rng.normal(size=(m, m))
    return RMP(f=jnp.asarray(rng.normal(size=m)), M=jnp.asarray(G @ G.T))


def _equal(a, b):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=ATOL), a, b)


@LAW
@given(SEEDS)
def test_pullback_of_identity_is_identity(seed):
    with jax.enable_x64(True):
        rmp = _rmp(np.random.default_rng(seed), 3)
        _equal(pullback(rmp, jnp.eye(3), jnp.zeros(3)), rmp)


@LAW
@given(SEEDS)
def test_pullbacks_compose(seed):
    """Child to parent to grandparent equals the composed map in one go."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(seed)
        rmp = _rmp(rng, 3)
        J_c, J_p = jnp.asarray(rng.normal(size=(3, 4))), rng.normal(size=(4, 5))
        c_c, c_p = jnp.asarray(rng.normal(size=3)), jnp.asarray(rng.normal(size=4))
        two_steps = pullback(pullback(rmp, J_c, c_c), jnp.asarray(J_p), c_p)
        _equal(two_steps, pullback(rmp, J_c @ J_p, J_c @ c_p + c_c))


@LAW
@given(SEEDS)
def test_pullback_commutes_with_addition(seed):
    with jax.enable_x64(True):
        rng = np.random.default_rng(seed)
        a, b = _rmp(rng, 3), _rmp(rng, 3)
        J, c = jnp.asarray(rng.normal(size=(3, 5))), jnp.asarray(rng.normal(size=3))
        _equal(pullback(a + b, J, c), pullback(a, J, c) + pullback(b, J, c))


@LAW
@given(SEEDS, st.floats(0.1, 10.0))
def test_pullback_is_linear_in_the_rmp(seed, s):
    with jax.enable_x64(True):
        rng = np.random.default_rng(seed)
        rmp = _rmp(rng, 3)
        J, c = jnp.asarray(rng.normal(size=(3, 5))), jnp.asarray(rng.normal(size=3))
        scaled = jax.tree.map(lambda leaf: s * leaf, rmp)
        _equal(
            jax.tree.map(lambda leaf: leaf / s, pullback(scaled, J, c)),
            pullback(rmp, J, c),
        )


@LAW
@given(SEEDS)
def test_pullback_keeps_the_metric_symmetric_and_positive(seed):
    with jax.enable_x64(True):
        rng = np.random.default_rng(seed)
        M = pullback(_rmp(rng, 3), jnp.asarray(rng.normal(size=(3, 5))), jnp.zeros(3)).M
        _equal(M, M.T)
        # 1e-12: the two zero eigenvalues are rounding.
        assert np.linalg.eigvalsh(M).min() > -ATOL


@LAW
@given(SEEDS)
def test_addition_is_commutative_associative_and_has_a_zero(seed):
    with jax.enable_x64(True):
        rng = np.random.default_rng(seed)
        a, b, c = _rmp(rng, 4), _rmp(rng, 4), _rmp(rng, 4)
        _equal(a + b, b + a)
        _equal((a + b) + c, a + (b + c))
        _equal(a + RMP.zero(4), a)


@LAW
@given(SEEDS)
def test_resolve_minimises_the_weighted_residuals(seed):
    """(M + W) qdd = f + W qdd_0 is the optimum of |qdd - a|_M^2 + |qdd - qdd_0|_W^2."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(seed)
        leaf, W = _rmp(rng, 4), _rmp(rng, 4).M + 0.1 * jnp.eye(4)
        a, qdd_0 = jnp.asarray(rng.normal(size=4)), jnp.asarray(rng.normal(size=4))
        rmp = RMP(f=leaf.M @ a, M=leaf.M)
        qdd = resolve(rmp, W, qdd_0)
        gradient = rmp.M @ (qdd - a) + W @ (qdd - qdd_0)
        # 1e-9: W keeps the condition below about 1e3, entries up to 1e2.
        np.testing.assert_allclose(gradient, 0.0, atol=1e-9)


def test_resolve_without_regulariser_solves_the_metric():
    rmp = RMP(f=jnp.asarray([2.0, 3.0]), M=jnp.diag(jnp.asarray([2.0, 6.0])))
    np.testing.assert_allclose(resolve(rmp), [1.0, 0.5], rtol=1e-6)


def test_resolve_of_nothing_is_the_preferred_acceleration():
    qdd_0 = jnp.asarray([1.0, -2.0])
    W = jnp.asarray([[2.0, 0.5], [0.5, 1.0]])
    # 1e-6: float32 rounding.
    np.testing.assert_allclose(resolve(RMP.zero(2), W, qdd_0), qdd_0, rtol=1e-6)


def test_resolve_refuses_a_preference_that_it_would_ignore():
    with pytest.raises(ValueError, match="regulariser"):
        resolve(RMP.zero(2), qdd_0=jnp.ones(2))


def test_coupled_osc_is_the_limit_of_a_small_inertia_regulariser():
    """The resolve tends to Mq^-1 J^T Lambda (xdd - Jdot qd) as eps goes to zero."""
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        Mq = _rmp(rng, 7).M + jnp.eye(7)
        J, c = jnp.asarray(rng.normal(size=(6, 7))), jnp.asarray(rng.normal(size=6))
        a = jnp.asarray(rng.normal(size=6))
        Mq_inv = jnp.linalg.inv(Mq)
        Lambda = jnp.linalg.inv(J @ Mq_inv @ J.T)
        osc = Mq_inv @ J.T @ Lambda @ (a - c)
        rmp = pullback(RMP(f=a, M=jnp.eye(6)), J, c)
        errors = [
            float(jnp.linalg.norm(resolve(rmp, eps * Mq) - osc))
            for eps in (1e-3, 1e-5, 1e-7)
        ]
    # First order in eps: two decades of eps are two decades of error (80 to 125).
    assert 80 < errors[0] / errors[1] < 125
    assert errors[2] < 1e-5 * float(np.linalg.norm(osc))
