"""The paper's controller: its leaves and no others, on an arm that compiles fast."""

import jax
import numpy as np
import pytest

from rmp_mjx import Obstacles, Robot, rmp_vices_literal
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state, site_state
from tests.control.conftest import QUICK
from tests.robot.test_model import GRIPPER

Q, QD = np.array([0.1, 0.5, -0.3]), np.array([0.4, -0.2, 0.3])
ACTION = np.full(12, 0.3)
FAR = [1e4, 0.0, 0.0]
"""The leaf has no range: its metric falls with the fourth power of the distance."""


@pytest.fixture(scope="module")
def literal():
    return rmp_vices_literal(Robot.from_mjcf(GRIPPER, site="tip", spacing=0.1))


@pytest.fixture(scope="module")
def act(literal):
    """Output, site, inertia and limiter's metric; float64."""

    @jax.jit(compiler_options=QUICK)
    def run(q, qd, center):
        slots = Obstacles.empty(spheres=1).with_spheres(center[None], 0.05)
        setpoint = literal.setpoint(q, literal.decode(ACTION), 0.0)
        arm = arm_state(literal.robot, q, qd)
        out = literal(q, qd, setpoint, slots)
        Mq, _ = dynamics(literal.robot, arm)
        limiter = literal.leaves.joint_limit.scalar(q, qd)[1]
        return out, site_state(literal.robot, arm), Mq, limiter

    def call(qd, center):
        with jax.enable_x64(True):
            return jax.device_get(run(Q, np.asarray(qd), np.asarray(center)))

    return call


def test_far_from_everything_the_root_is_attractors_and_limiter(act):
    """1e-12: rounding. The limiter stands on the limited joints' diagonal alone."""
    out, site, _, limiter = act(QD, FAR)
    rest = out.M - site.J_pos.T @ site.J_pos - site.J_ori.T @ site.J_ori
    np.testing.assert_allclose(rest, np.diag(limiter), atol=1e-12)
    np.testing.assert_array_equal(limiter > 0, [False, True, False])


def test_obstacle_weighs_nothing_at_rest_however_near(act):
    """Why a slow push wins: the metric vanishes with the speed."""
    near, far = [0.3, 0.0, 0.4], FAR
    still = np.zeros(3)
    assert act(still, near)[0].diagnostics["clearance"] < 0.1
    np.testing.assert_array_equal(act(still, near)[0].M, act(still, far)[0].M)
    moving, free = act(QD, near)[0].M, act(QD, far)[0].M
    assert np.abs(moving - free).max() > 1.0


def test_acceleration_is_the_roots_up_to_its_regulariser(literal, act):
    """`REGULARIZER` Mq against a root of order one."""
    out, _, Mq, _ = act(QD, FAR)
    np.testing.assert_allclose(
        (out.M + literal.regularizer * Mq) @ out.qdd, out.f, rtol=1e-6, atol=1e-6
    )
    np.testing.assert_allclose(out.M @ out.qdd, out.f, atol=1e-3 * np.abs(out.f).max())
