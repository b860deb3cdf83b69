"""Inverse kinematics against MuJoCo C."""

import mujoco
import numpy as np
import pytest

from rmp_mjx import Robot
from rmp_mjx.robot.configurations import random_configurations
from rmp_mjx.robot.inverse import hand_pose, reach


@pytest.mark.parametrize("name", ["panda", "ur5e"])
def test_it_reaches_poses_near_by_within_the_limits(name):
    """Poses of configurations 0.1 rad away at every joint; MuJoCo C measures.

    99 of 100 to 1e-4 m plus rad: damping keeps it off exact poses near singularities.
    """
    robot, rng = Robot.load(name), np.random.default_rng(0)
    q = np.clip(
        random_configurations(robot, 300), robot.q_lower + 0.1, robot.q_upper - 0.1
    )
    p, R = hand_pose(robot, q)
    found, miss = reach(robot, q + rng.choice([-0.1, 0.1], q.shape), p, R, steps=30)
    assert (found >= robot.q_lower).all() and (found <= robot.q_upper).all()
    assert (miss < 1e-4).mean() > 0.97
    model = robot.mj_model
    data, site = mujoco.MjData(model), model.site(robot.site_name).id
    for k in np.flatnonzero(miss < 1e-4)[:50]:
        data.qpos[:] = found[k]
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.site_xpos[site], p[k], atol=1e-4)
        np.testing.assert_allclose(data.site_xmat[site].reshape(3, 3), R[k], atol=2e-4)


def test_what_is_out_of_reach_is_said_to_be():
    robot = Robot.load("ur5e")
    p, R = hand_pose(robot, robot.q_home[None])
    _, miss = reach(robot, robot.q_home[None], p + np.array([2.0, 0.0, 0.0]), R)
    assert miss[0] > 0.25


def test_a_redundant_arm_stays_near_where_it_rests():
    robot = Robot.load("panda")
    q = robot.q_home[None] + 0.0
    p, R = hand_pose(robot, q)
    other, _ = reach(robot, q, p, R, steps=100, rest=q + 0.3)
    assert np.abs(other - q).max() > 0.05  # it moves within its null space
    np.testing.assert_allclose(hand_pose(robot, other)[0], p, atol=1e-3)
    back, _ = reach(robot, other, p, R, steps=300, rest=q)
    np.testing.assert_allclose(back, q, atol=0.02)
