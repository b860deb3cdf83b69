"""The barrier against its derivation in docs/maths.md, written out in NumPy.

tests/test_docs.py holds the page and the leaf's docstring to one formula.
"""

import jax
import numpy as np
import pytest

from rmp_mjx.rmp import leaves

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
