"""Torque limits and the time to stop: properties by hypothesis, in float32."""

import jax
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rmp_mjx.control.torque import clip_torque, stop_time

N = 3
LIMIT = np.array([30.5, 6.8, 0.5], np.float32)


# XLA flushes subnormal numbers to zero: they are not drawn.
def _vectors(most):
    number = st.floats(-most, most, width=32, allow_subnormal=False)
    return st.lists(number, min_size=N, max_size=N).map(lambda v: np.array(v, "f"))


vectors = _vectors(2.0**50)
compiled = settings(deadline=None)  # the first call compiles
clip = jax.jit(clip_torque)
stopping = jax.jit(stop_time)


@compiled
@given(vectors)
def test_clipping_works_joint_by_joint(tau):
    clipped, limit = (np.asarray(x) for x in clip(tau, -LIMIT, LIMIT))
    np.testing.assert_array_equal(clipped, np.clip(tau, -LIMIT, LIMIT))
    np.testing.assert_array_equal(
        limit, np.sign(clipped) * (np.abs(clipped) == LIMIT).astype("f")
    )


@compiled
@given(_vectors(3.0), _vectors(0.5), _vectors(1.0))
def test_the_arm_can_stop_in_its_time_to_stop(qd, load, numbers):
    """The torque for it is within the limits (1e-5), and at one of them.

    A load beyond 95 % of its limit is not drawn: there the time is a convention.
    """
    A = np.diag(LIMIT) + 0.1 * np.outer(numbers, numbers)
    A = A.astype("f")
    load = np.float32(load * LIMIT)
    T = np.float64(stopping(A, load, qd, LIMIT))
    assert T >= 0.0
    if T > 1e-6:
        tau = load - A @ qd.astype(float) / T
        used = np.max(np.abs(tau) / LIMIT)
        assert abs(used - 1.0) < 1e-4
    half = np.float64(stopping(A, load, qd, LIMIT, 0.5))
    np.testing.assert_allclose(half, 2.0 * T, rtol=1e-5)
