"""Bounds of the arm: no motion exceeds them, and they are not idle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmp_mjx import Robot
from rmp_mjx.robot.bounds import Bounds, centre_levers
from rmp_mjx.robot.dynamics import dynamics, holding_torque
from rmp_mjx.robot.kinematics import arm_state
from rmp_mjx.robot.point_state import point_state
from tests.control.conftest import QUICK
from tests.robot.test_model import GRIPPER


@pytest.fixture(scope="module", params=["jaco", "gripper"])
def arm(request, robot):
    """The Jaco 2, and an arm of another build."""
    gripper = Robot.from_mjcf(GRIPPER, site="tip", spacing=0.1)
    return robot if request.param == "jaco" else gripper


def length(v):
    return jnp.sqrt(v @ v)


@pytest.fixture(scope="module")
def motion(arm):
    """`motion(q, qd)`: what the bounds bound, by name, and the bounds; float64."""
    bounds = Bounds.of(arm)
    segment, n = np.array(arm.points.segment), arm.n

    def both(q, qd):
        state = arm_state(arm, q, qd)
        points, size = point_state(arm, state), jnp.abs(qd)
        squares = jnp.outer(size, size).reshape(-1)
        spin = length(state.V.ang)[segment] * arm.points.radius

        def moved(q):
            state = arm_state(arm, q, qd)
            Mq, _ = dynamics(arm, state)
            return jnp.matmul(Mq, qd, precision="highest")

        def held(q):
            return holding_torque(arm, arm_state(arm, q, jnp.zeros(n)))

        _, rate = jax.jvp(moved, (q,), (qd,))
        _, load = jax.jvp(held, (q,), (qd,))
        coriolis = dynamics(arm, state)[1] - holding_torque(arm, state)
        if arm.damping is not None:
            coriolis = coriolis - arm.damping * qd
        R = centre_levers(arm, state)
        most, most_rate, most_load = bounds.torques(arm, R, qd)
        later = centre_levers(arm, arm_state(arm, q + 0.2 * qd, qd))
        return {
            "speed": (
                jnp.sqrt(points.v @ points.v) + spin,
                (bounds.lever @ size)[segment],
            ),
            "bend": (jnp.sqrt(points.a @ points.a), (squares @ bounds.bend)[segment]),
            "coriolis": (jnp.abs(coriolis), most),
            "inertia": (jnp.abs(rate), most_rate),
            "load": (jnp.abs(load), most_load),
            "levers": (later, bounds.levers(R, qd, 0.2)),
        }

    compiled = jax.jit(both, compiler_options=QUICK)

    def run(q, qd):
        with jax.enable_x64(True):
            return jax.device_get(compiled(q, qd))

    return run


@settings(max_examples=200, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 127))
def test_no_motion_exceeds_the_bounds(arm, motion, seed, joints):
    """Any configuration, any joints at any speeds. 1e-9: rounding of float64."""
    rng = np.random.default_rng(seed)
    some = (joints >> np.arange(arm.n)) & 1
    q, qd = rng.uniform(-np.pi, np.pi, arm.n), some * rng.normal(size=arm.n)
    for name, (value, bound) in motion(q, qd).items():
        assert np.all(value <= bound + 1e-9), name


def test_the_bounds_are_not_idle(arm, motion):
    """A turn of one joint takes up a third of each, and nine tenths of a lever."""
    rng = np.random.default_rng(0)
    best = {}
    for _ in range(300):
        q, qd = rng.uniform(-np.pi, np.pi, arm.n), np.eye(arm.n)[rng.integers(arm.n)]
        for name, (value, bound) in motion(q, qd).items():
            used = np.where(bound > 1e-6, value / np.maximum(bound, 1e-6), 0.0).max()
            best[name] = max(best.get(name, 0.0), used)
    assert best["speed"] > 0.9
    assert min(best[k] for k in ("bend", "load", "levers")) > 1 / 3


def test_the_holding_torque_is_the_bias_at_rest(arm):
    with jax.enable_x64(True):
        q = jnp.asarray(arm.q_home + 0.3)
        state = arm_state(arm, q, jnp.zeros(arm.n))
        held, bias = holding_torque(arm, state), dynamics(arm, state)[1]
    np.testing.assert_allclose(held, bias, atol=1e-12)
