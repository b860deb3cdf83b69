"""Kinematics and dynamics of the Jaco 2 against two engines, in float64.

1,200 random states. Tolerances are a few hundred rounding errors of the largest
number in each quantity (1 m, 10 rad/s, 100 N m).
"""

import mujoco
import numpy as np
import pytest

from rmp_mjx import Robot
from tests import oracles

TOLERANCE = {
    "p": 1e-12,
    "R": 1e-12,
    "J": 1e-12,
    "Jdot_qd": 1e-10,
    "Mq": 1e-12,
    "bias": 1e-10,
}


@pytest.fixture(scope="module")
def terms(ours, robot, states):
    return ours(robot, *states)[0]


def _assert_equal(terms, expected):
    for name, tolerance in TOLERANCE.items():
        np.testing.assert_allclose(
            getattr(terms, name),
            getattr(expected, name),
            rtol=0.0,
            atol=tolerance,
            err_msg=name,
        )


def test_all_terms_equal_mujoco(robot, states, terms):
    """FK, Jacobian, curvature, inertia and bias; at least 1,000 states."""
    assert len(states[0]) >= 1000
    expected = oracles.mujoco_terms(robot.mj_model, robot.site_name, *states)
    _assert_equal(terms, expected)


def test_all_terms_equal_pinocchio(robot, states, terms, tmp_path):
    """A second engine that shares no code with MuJoCo but the MJCF."""
    pin = pytest.importorskip("pinocchio")
    path = tmp_path / "arm.xml"
    path.write_text(robot.mjcf)
    expected = oracles.pinocchio_terms(pin, str(path), robot.site_name, *states)
    _assert_equal(terms, expected)


def test_robosuite_armature_equals_mujoco(states, ours):
    """The other shipped setting: rotor inertias of 5/(i+1) kg m^2."""
    robot = Robot.load(armature="robosuite")
    q, qd = (x[:50] for x in states)
    # MuJoCo writes the arm's text with six digits.
    np.testing.assert_allclose(robot.armature, 5.0 / (np.arange(7) + 1.0), rtol=1e-5)
    expected = oracles.mujoco_terms(robot.mj_model, robot.site_name, q, qd)
    # `ours` is compiled for 1,200 states: use it again and compare 50 of them.
    terms = oracles.Terms(*(term[:50] for term in ours(robot, *states)[0]))
    _assert_equal(terms, expected)


def test_torque_through_mujoco_gives_the_acceleration_back(robot, states, terms):
    """mj_forward with tau = Mq qdd + bias; 1e-9 of 20 rad/s^2: cond(Mq) is 1e2."""
    model = oracles.without_limits_or_passive_forces(robot.mj_model)
    data = mujoco.MjData(model)
    qdd = np.random.default_rng(1).normal(scale=20.0, size=states[0].shape)
    for k, (q, qd) in enumerate(zip(*states, strict=True)):
        data.qpos[:], data.qvel[:] = q, qd
        data.qfrc_applied[:] = terms.Mq[k] @ qdd[k] + terms.bias[k]
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.qacc, qdd[k], rtol=0.0, atol=1e-9 * 20.0)


def test_inertia_is_symmetric_positive_definite(robot, terms):
    """Exactly symmetric, and never below the least rotor inertia."""
    np.testing.assert_array_equal(terms.Mq, terms.Mq.swapaxes(1, 2))
    assert np.linalg.eigvalsh(terms.Mq).min() >= robot.armature.min()


def test_units_are_those_of_a_jaco_arm(robot, terms):
    """Reach, mass and holding torque of the real arm: metres, kilograms, newtons."""
    assert 0.8 < np.linalg.norm(terms.p, axis=1).max() < 1.3
    assert 4.0 < robot.mass.sum() < 6.0
    np.testing.assert_allclose(np.linalg.norm(robot.gravity), 9.81, rtol=1e-12)
    assert robot.tau_max.tolist() == [30.5] * 5 + [6.8] * 2
