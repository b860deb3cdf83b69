"""Where an arm stands, and the finger of an arm with a bare flange."""

import mujoco
import numpy as np
import pytest

from rmp_mjx import Robot, RobotError

PLACE = np.array([-0.1, 0.2, 0.3])
TURN = np.pi / 4


@pytest.fixture(scope="module")
def bare():
    return Robot.load("ur5e")


@pytest.fixture(scope="module")
def fingered():
    return Robot.load("ur5e", mount=PLACE, finger=TURN)


def grip(robot):
    """Position and orientation of the end effector, by MuJoCo C."""
    model = robot.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = robot.q_home
    mujoco.mj_kinematics(model, data)
    site = model.site(robot.site_name).id
    return data.site_xpos[site].copy(), data.site_xmat[site].reshape(3, 3).copy()


def test_the_grip_is_15_cm_out_of_the_flange_and_turned_about_the_finger(
    bare, fingered
):
    (p, R), (q, S) = grip(bare), grip(fingered)
    # MuJoCo writes six digits.
    np.testing.assert_allclose(q, p + PLACE + 0.15 * R[:, 2], atol=2e-6)
    c = np.cos(TURN)
    np.testing.assert_allclose(R.T @ S, [[c, -c, 0], [c, c, 0], [0, 0, 1]], atol=2e-6)


def test_seen_from_the_grip_the_finger_ends_as_the_jacos(fingered):
    """Tip and radius, in the frame of the grip; the other end is at the flange."""
    jaco = Robot.load("jaco2")
    tips, radii = [], []
    for robot, geom in ((jaco, "fingers"), (fingered, "finger")):
        k = robot.capsules.geom.index(geom)
        assert robot.capsules.segment[k] == robot.n - 1
        ends = np.stack([robot.capsules.start[k], robot.capsules.end[k]])
        seen = (ends - robot.site_offset) @ robot.site_rotation
        first, last = seen[np.argsort(seen[:, 2])]
        tips.append(last)
        radii.append(robot.capsules.radius[k])
    np.testing.assert_allclose(*tips, atol=2e-6)
    np.testing.assert_allclose(first, [0.0, 0.0, -0.15], atol=2e-6)  # the flange
    assert radii[0] == radii[1]


def test_the_finger_is_part_of_the_arm(bare, fingered):
    assert fingered.mass[-1] - bare.mass[-1] == pytest.approx(0.06, abs=1e-6)
    known = np.array(fingered.points.body)
    assert (known == "finger").sum() >= 10
    finger = fingered.capsules.geom.index("finger")
    assert any(finger in pair for pair in fingered.capsules.pairs)


def test_the_finger_is_seen_and_collides(fingered):
    """An opaque colour, and the same masks as the Jaco 2's geoms."""
    geom, jaco = fingered.mj_model.geom("finger"), Robot.load("jaco2").mj_model
    assert ((geom.rgba >= 0.0) & (geom.rgba <= 1.0)).all() and geom.rgba[3] == 1.0
    assert geom.contype[0] == jaco.geom("fingers").contype[0]
    assert geom.conaffinity[0] == jaco.geom("fingers").conaffinity[0]


def test_the_base_stands_elsewhere_and_nothing_else_changes(bare):
    moved = Robot.load("ur5e", mount=PLACE)
    np.testing.assert_allclose(moved.offset[0] - bare.offset[0], PLACE, atol=1e-9)
    base = bare.capsules.geom.index("base")
    np.testing.assert_allclose(
        moved.capsules.start[base] - bare.capsules.start[base], PLACE, atol=1e-9
    )
    np.testing.assert_allclose(moved.offset[1:], bare.offset[1:], atol=1e-12)
    assert moved.fingerprint != bare.fingerprint


def test_names_that_are_taken_get_a_number(fingered):
    """A finger on the finger; and one more."""
    robot = fingered
    for k in (1, 2):
        site, home = robot.site_name, robot.q_home
        robot = Robot.from_mjcf(robot.mjcf, site, finger=0.0, q_home=home)
        assert robot.site_name == f"grip_{k}"
        assert robot.points.body[-1] == robot.capsules.geom[-1] == f"finger_{k}"


def test_a_wrong_place_is_refused():
    with pytest.raises(RobotError, match="mount must be 3 finite numbers"):
        Robot.load("ur5e", mount=[0.0, 1.0])
