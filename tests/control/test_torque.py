"""Torque limits and the time to stop: properties by hypothesis, in float32."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmp_mjx.control.torque import (
    HORIZON,
    clip_torque,
    speed_range,
    stop_time,
    torque_range,
)

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


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_torque_at_its_limit_counts_as_at_it(side):
    tau = side * LIMIT
    for change, expected in ((1.0, side), (0.999, 0.0), (1.001, side)):
        clipped, limit = clip(np.float32(change) * tau, -LIMIT, LIMIT)
        np.testing.assert_array_equal(limit, np.full(N, expected))
        assert np.all(np.abs(clipped) <= LIMIT)


@pytest.mark.parametrize("load", [0.94, 0.96, 1.0, 1.5])
def test_a_load_near_the_limit_leaves_a_twentieth_of_it(load):
    """The time is that of momentum over room: the load pulls on as the joint turns."""
    A, qd = np.diag([2.0, 3.0, 4.0]).astype("f"), np.array([0.0, -0.5, 0.0], "f")
    most = np.full(N, 10.0, "f")
    found = stopping(A, np.float32(10.0 * load) * np.ones(N, "f"), qd, most)
    np.testing.assert_allclose(found, 1.5 / max(0.5, 10.0 * (1.0 - load)), rtol=1e-4)


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


@pytest.fixture(scope="module")
def rated(bent):
    """An arm whose torques change by 2, 30, 400 and 5000 N m/s at most."""
    return bent.replace(tau_rate_max=np.array([2.0, 30.0, 400.0, 5000.0]))


def test_without_a_rate_or_a_last_torque_the_range_is_the_limits(bent, rated):
    high = np.float32(bent.tau_max)
    for robot, last in ((bent, None), (bent, np.ones(4, "f")), (rated, None)):
        found = torque_range(robot, last, 0.1)
        np.testing.assert_array_equal(found, [-high, high])


@compiled
@given(_vectors(1.0), st.floats(1e-3, 0.5))
def test_torques_change_by_their_rate_from_the_last_one_within_the_limits(
    rated, share, period
):
    """Last torques up to twice the limits, which count as at the limit; 1e-5 of 90."""
    last = np.float32(2.0 * rated.tau_max * [*share, -share[0]])
    low, high = torque_range(rated, last, period)
    most = rated.tau_max
    start, step = np.clip(last, -most, most), rated.tau_rate_max * period
    np.testing.assert_allclose(low, np.maximum(start - step, -most), atol=1e-3)
    np.testing.assert_allclose(high, np.minimum(start + step, most), atol=1e-3)
    assert np.all(low <= high)


@compiled
@given(_vectors(3.0), _vectors(9.0), st.floats(1e-3, 0.05))
def test_the_range_of_accelerations_ends_just_below_the_greatest_speeds(
    qd, contact, period
):
    """Held for five periods, with what contacts add, the joints come to 99 % of their
    greatest speed, either way. 1e-5: float32."""
    most = np.array([0.5, 2.0, 4.0])
    for w in (None, jnp.asarray(contact)):
        felt = 0.0 if w is None else contact
        found = speed_range(most, jnp.asarray(qd), w, period)
        for side, held in zip((-1, 1), found, strict=True):
            reached = qd + (np.asarray(held, float) + felt) * 5 * period
            np.testing.assert_allclose(reached, side * 0.99 * most, atol=1e-5)
    assert HORIZON == 5
