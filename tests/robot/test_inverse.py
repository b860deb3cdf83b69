"""Inverse kinematics against MuJoCo C."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rmp_mjx import Robot
from rmp_mjx.robot import inverse
from rmp_mjx.robot.configurations import random_configurations
from rmp_mjx.robot.inverse import STEP, _at_most, _error, hand_pose, reach
from tests.oracles import Measured


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


def test_the_error_is_a_shift_and_a_turn_and_the_jacobian_is_mujocos(bent):
    """40 configurations of an arm with a slide; turns up to 170 degrees by scipy. At
    most 0.3 m and 0.3 rad of them count. 1e-9: rounding, near half a turn too."""
    measured, q, rng = Measured(bent), random_configurations(bent, 40), np.random
    p, R = hand_pose(bent, q)
    draw = rng.default_rng(0)
    shift, turn = draw.normal(scale=0.2, size=(2, 40, 3))
    turn *= (np.linspace(0.01, 2.97, 40) / np.linalg.norm(turn, axis=1))[:, None]
    target = Rotation.from_rotvec(turn).as_matrix() @ R
    error, J = _error(bent, q, p + shift, target)
    model, site = bent.mj_model, bent.mj_model.site("tip").id
    for k, q_k in enumerate(q):
        data = measured.at(q_k)
        mujoco.mj_comPos(model, data)
        np.testing.assert_allclose(data.site_xpos[site], p[k], atol=1e-12)
        np.testing.assert_allclose(data.site_xmat[site], R[k].ravel(), atol=1e-12)
        theirs = np.zeros((6, 4))
        mujoco.mj_jacSite(model, data, theirs[:3], theirs[3:], site)
        np.testing.assert_allclose(J[k], theirs, atol=1e-12)
        for part, whole in ((error[k, :3], shift[k]), (error[k, 3:], turn[k])):
            length = np.linalg.norm(whole)
            expected = whole * min(1.0, STEP / length)
            np.testing.assert_allclose(part, expected, atol=1e-9)
    none, _ = _error(bent, q, p, R)
    np.testing.assert_allclose(none, 0.0, atol=1e-12)
    with np.errstate(all="raise"):
        np.testing.assert_array_equal(_at_most(np.zeros((2, 3))), 0.0)


def test_no_step_is_longer_than_a_third_of_a_radian(bent):
    """Asked for far more; and what is left is the distance plus the angle."""
    q = random_configurations(bent, 30)
    p, R = hand_pose(bent, q)
    found, left = reach(bent, q, p + 5.0, R, steps=1)
    assert np.abs(found - q).max() <= STEP + 1e-12
    np.testing.assert_allclose(np.abs(found - q).max(axis=1).max(), STEP, rtol=1e-6)
    near, _ = hand_pose(bent, found)
    assert np.all(left >= STEP - 1e-9) and near.shape == p.shape
    same, none = reach(bent, q, p, R, steps=3)
    np.testing.assert_allclose(same, q, atol=1e-9)
    np.testing.assert_allclose(none, 0.0, atol=1e-9)
    aside = p + np.array([0.01, 0.02, 0.02])
    shifted = reach(bent, q, aside, R, steps=0)[1]
    np.testing.assert_allclose(shifted, 0.03, atol=1e-9)
    turned = Rotation.from_rotvec([0.03, -0.04, 0.12]).as_matrix() @ R
    both = reach(bent, q, aside, turned, steps=0)[1]
    np.testing.assert_allclose(both, 0.03 + 0.13, atol=1e-9)


def test_a_step_is_that_of_damped_least_squares(bent):
    """Its normal equations, with MuJoCo's Jacobian; the damping 1e-6 plus a hundredth
    of the error's square also lets a fifth of the way to rest through."""
    measured, q = Measured(bent), random_configurations(bent, 60)
    rng, site = np.random.default_rng(0), bent.mj_model.site("tip").id
    p, R = hand_pose(bent, q)
    size = np.linspace(0.001, 0.2, 60)[:, None]
    shift, turn = size * rng.uniform(-1, 1, (2, 60, 3))
    rest = q + rng.uniform(-1, 1, q.shape)
    turned = Rotation.from_rotvec(turn).as_matrix() @ R
    found, _ = reach(bent, q, p + shift, turned, steps=1, rest=rest)
    shortened = 0
    for k, q_k in enumerate(q):
        data, J = measured.at(q_k), np.zeros((6, 4))
        mujoco.mj_comPos(bent.mj_model, data)
        mujoco.mj_jacSite(bent.mj_model, data, J[:3], J[3:], site)
        error = np.concatenate([_at_most(x[k : k + 1])[0] for x in (shift, turn)])
        damping = 1e-6 + 1e-2 * error @ error
        wanted = J.T @ error + damping * 0.2 * (rest[k] - q_k)
        move = np.linalg.solve(J.T @ J + damping * np.eye(4), wanted)
        shortened += np.abs(move).max() > STEP
        move *= min(1.0, STEP / np.abs(move).max())
        expected = np.clip(q_k + move, bent.q_lower, bent.q_upper)
        np.testing.assert_allclose(found[k], expected, rtol=0.0, atol=1e-9)
    assert 5 < shortened < 55


def test_fifty_steps_are_taken(bent, monkeypatch):
    """And what is left is measured once more."""
    calls = []

    def error(*args):
        calls.append(args)
        return _error(*args)

    monkeypatch.setattr(inverse, "_error", error)
    p, R = hand_pose(bent, bent.q_home[None])
    reach(bent, bent.q_home[None], p + 5.0, R)
    assert len(calls) == 51


def test_a_redundant_arm_moves_to_its_rest_as_far_as_the_hand_stays():
    """Seven joints: nothing of the way to rest is left in the null space, 1e-3 rad, in
    nine of ten; and without a rest it stays where it began."""
    robot = Robot.load("jaco2")
    rng = np.random.default_rng(0)
    q = robot.q_home + rng.uniform(-0.3, 0.3, (40, 7))
    rest = q + rng.uniform(-0.2, 0.2, (40, 7))
    p, R = hand_pose(robot, q)
    stayed, _ = reach(robot, q, p, R)
    np.testing.assert_allclose(stayed, q, atol=1e-9)
    found, miss = reach(robot, q, p, R, steps=100, rest=rest)
    assert (miss < 1e-3).mean() > 0.9
    _, J = _error(robot, found, p, R)
    null = np.linalg.svd(J)[2][:, -1]
    left = np.abs(((rest - found) * null).sum(axis=1))
    assert (left < 1e-3).mean() > 0.9
    assert (np.linalg.norm(found - q, axis=1) > 0.01).mean() > 0.8
