"""The nominal posture is within the joint ranges, whatever the file says."""

import re
import warnings

import numpy as np
import pytest

from rmp_mjx import Robot, RobotError, RobotWarning


def text(second="-2 2", key="", first=""):
    return f"""<mujoco><compiler angle="radian"/><worldbody><body name="one">
    <joint name="a" axis="0 0 1" {first}/>
    <geom name="one" type="capsule" size=".05 .1"/>
    <body name="two" pos="0 0 .3"><joint name="b" axis="0 1 0" range="{second}"/>
    <geom name="two" type="capsule" size=".04 .1"/><site name="tip"/></body></body>
    </worldbody><actuator><motor joint="a" ctrlrange="-5 5"/>
    <motor joint="b" ctrlrange="-5 5"/></actuator><keyframe>{key}</keyframe></mujoco>"""


HOME = '<key name="home" qpos="{} {}"/>'


def load(mjcf, **kwargs):
    return Robot.from_mjcf(mjcf, site="tip", **kwargs)


def test_the_keyframe_home_is_the_posture():
    robot = load(text(key='<key name="up" qpos="1 1"/>' + HOME.format(0.3, -1.9)))
    np.testing.assert_allclose(robot.q_home, [0.3, -1.9])


def test_a_keyframe_outside_a_range_is_refused():
    message = "keyframe 'home' puts joint 'b' at 2.5, outside its range [-2, 2]: pass"
    with pytest.raises(RobotError, match=re.escape(message)):
        load(text(key=HOME.format(0.3, 2.5)))


def test_a_posture_given_replaces_the_files():
    robot = load(text(key=HOME.format(0.3, 2.5)), q_home=[7.0, 2.0])
    assert robot.q_home.tolist() == [7.0, 2.0]  # joint a turns freely


@pytest.mark.parametrize(
    ("q_home", "message"),
    [
        ([0.0, -2.1], "q_home puts joint 'b' at -2.1, outside its range [-2, 2]"),
        ([0.0], "q_home must be 2 finite numbers, got [0.0]"),
        ([0.0, float("nan")], "q_home must be 2 finite numbers"),
    ],
)
def test_a_bad_posture_is_refused(q_home, message):
    with pytest.raises(RobotError, match=re.escape(message)):
        load(text(), q_home=q_home)


@pytest.mark.parametrize(
    ("span", "middle"),
    [("-3 -0.1", -1.55), ("0.5 1", 0.75), ("-0.1 4", 1.95), ("-4 0.1", -1.95)],
    ids=["above", "below", "near the lower end", "near the upper end"],
)
def test_without_a_keyframe_a_joint_at_its_end_rests_at_mid_range(span, middle):
    with pytest.warns(RobotWarning, match=r"'b' \(0, range .* Pass q_home="):
        robot = load(text(span))
    np.testing.assert_allclose(robot.q_home, [0.0, middle])


def test_a_reference_pose_well_within_the_ranges_is_the_posture():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        robot = load(text(first='ref=".7"'))
    np.testing.assert_allclose(robot.q_home, [0.7, 0.0])
