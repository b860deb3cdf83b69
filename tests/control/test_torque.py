"""Torque limits: properties for any torque, by hypothesis, in float32."""

import jax
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rmp_mjx.control.torque import clip_torque, scale_torque

N = 3
LIMIT = np.array([30.5, 6.8, 0.5], np.float32)


# Torques far beyond any arm's, but no overflow of float32 in the sum of two.
# XLA flushes subnormal numbers to zero: they are not drawn.
def _vectors(most):
    number = st.floats(-most, most, width=32, allow_subnormal=False)
    return st.lists(number, min_size=N, max_size=N).map(lambda v: np.array(v, "f"))


vectors, biases = _vectors(2.0**50), _vectors(60)
compiled = settings(deadline=None)  # the first call compiles
scale = jax.jit(scale_torque)
clip = jax.jit(clip_torque)


@compiled
@given(vectors, biases)
def test_scaled_torque_is_within_the_limits_and_keeps_the_direction(dynamic, bias):
    """tau - bias = k dynamic with k in [0, 1]; 1e-5 of the limit: float32."""
    tau, k = (np.asarray(x) for x in scale(dynamic, bias, LIMIT))
    held = np.clip(bias, -LIMIT, LIMIT)
    assert np.all(np.abs(tau) <= LIMIT)
    assert 0.0 <= k <= 1.0
    expected = held + np.float64(k) * dynamic
    np.testing.assert_allclose(tau, expected, rtol=0.0, atol=1e-5 * LIMIT.max())


@compiled
@given(vectors, biases)
def test_scale_is_as_large_as_fits(dynamic, bias):
    """Either nothing is taken away, or one joint stands at its limit."""
    tau, k = (np.asarray(x) for x in scale(dynamic, bias, LIMIT))
    at_limit = np.abs(np.abs(tau) - LIMIT) <= 1e-5 * LIMIT
    assert k == 1.0 or at_limit.any()


@compiled
@given(biases)
def test_nothing_asked_gives_the_bias(bias):
    tau, k = scale(np.zeros(N, "f"), bias, LIMIT)
    assert k == 1.0
    np.testing.assert_array_equal(tau, np.clip(bias, -LIMIT, LIMIT))


@compiled
@given(vectors)
def test_torque_that_fits_is_untouched(dynamic):
    small = dynamic / max(1.0, 1.01 * np.max(np.abs(dynamic) / LIMIT))
    small = np.where(np.abs(small) < 1e-30, 0.0, small)
    tau, k = scale(small.astype("f"), np.zeros(N, "f"), LIMIT)
    assert k == 1.0
    np.testing.assert_array_equal(tau, small.astype("f"))


@compiled
@given(vectors)
def test_clipping_works_joint_by_joint(tau):
    clipped, k = (np.asarray(x) for x in clip(tau, LIMIT))
    np.testing.assert_array_equal(clipped, np.clip(tau, -LIMIT, LIMIT))
    expected = np.min(LIMIT / np.maximum(np.abs(tau), LIMIT))
    np.testing.assert_allclose(k, expected, rtol=1e-6)
