"""Files as people have them: URDF, two arms, mimic joints, nothing that collides."""

import re

import numpy as np
import pytest

from rmp_mjx import Robot, RobotError, RobotWarning

INERTIA = '<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/>'
URDF = f"""<robot name="two"><link name="base"/>
<link name="arm"><inertial><mass value="1"/><origin xyz="0 0 .1"/>{INERTIA}</inertial>
<collision><origin xyz="0 0 .1"/><geometry><cylinder radius=".04" length=".2"/>
</geometry></collision></link>
<link name="tip"><inertial><mass value=".1"/>{INERTIA}</inertial></link>
<joint name="a" type="revolute"><parent link="base"/><child link="arm"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="30" velocity="2"/></joint>
<joint name="b" type="continuous"><parent link="arm"/><child link="tip"/>
<origin xyz="0 0 .2"/><axis xyz="0 1 0"/><limit effort="10" velocity="3"/></joint>
</robot>"""


def test_a_urdf_brings_its_limits_and_its_continuous_joints(tmp_path):
    """A cylinder's capsule has its radius and a little more: the polygon round it."""
    path = tmp_path / "two.urdf"
    path.write_text(URDF)
    robot = Robot.load(str(path), body="tip")
    assert robot.joint_names == ("a", "b") and robot.tau_max.tolist() == [30.0, 10.0]
    np.testing.assert_array_equal(robot.qd_max, [2.0, 3.0])
    np.testing.assert_allclose(robot.q_lower, [-1.0, -np.inf])
    assert 0.04 < robot.capsules.radius[0] < 0.055
    for unknown in ("", 'velocity="0"'):
        path.write_text(URDF.replace('velocity="3"', unknown))
        assert Robot.load(str(path), body="tip").qd_max is None


def arm(name, y, geom="", more=""):
    return f"""<body name="{name}_upper" pos="0 {y} 0"><joint name="{name}1"
    axis="0 1 0"/><geom name="{name}_upper" type="capsule" fromto="0 0 0 0 0 .3"
    size=".04" {geom}/><body name="{name}_fore" pos="0 0 .3"><joint name="{name}2"
    axis="0 1 0"/><geom name="{name}_fore" type="capsule" fromto="0 0 0 .2 0 0"
    size=".03" {geom}/><site name="{name}_tip" pos=".2 0 0"/>{more}</body></body>"""


def scene(bodies, rest=""):
    motors = "".join(
        f'<motor joint="{name}" ctrlrange="-9 9"/>'
        for name in re.findall(r'joint name="(\w+)"', bodies)
        if not name.startswith("finger")
    )
    return f"""<mujoco><worldbody><site name="table"/>{bodies}</worldbody>
    <actuator>{motors}</actuator>{rest}</mujoco>"""


@pytest.mark.parametrize(("one", "other"), [("right", "left"), ("left", "right")])
def test_the_site_picks_one_of_two_arms(one, other):
    """The other one stands still in the way: its capsules are of the fixed base."""
    robot = Robot.from_mjcf(scene(arm("left", 0.2) + arm("right", -0.2)), f"{one}_tip")
    assert robot.joint_names == (f"{one}1", f"{one}2")
    segments = dict(zip(robot.capsules.geom, robot.capsules.segment, strict=True))
    assert segments[f"{one}_fore"] == 1 and segments[f"{other}_fore"] == -1


def test_a_mimic_joint_on_the_chain_is_named_and_fingers_are_not():
    finger = """<body name="finger"><joint name="finger1" type="slide"/>
    <geom name="finger" size=".02"/></body><body name="thumb"><joint name="finger2"
    type="slide"/><geom name="thumb" size=".02"/></body>"""
    fingers = '<equality><joint joint1="finger1" joint2="finger2"/></equality>'
    hand = scene(arm("a", 0, more=finger), fingers)
    mimic = fingers.replace('joint2="finger2"', 'joint2="a2"')
    with pytest.warns(RobotWarning, match=r"an equality couples joint \['a2'\]"):
        coupled = Robot.from_mjcf(hand.replace(fingers, mimic), "a_tip")
    assert coupled.joint_names == Robot.from_mjcf(hand, "a_tip").joint_names
    assert "finger" in coupled.capsules.geom


def test_an_arm_of_which_nothing_collides_gets_capsules_of_all_it_has():
    ghost = scene(arm("a", 0, geom='contype="0" conaffinity="0"'))
    with pytest.warns(RobotWarning, match="no geom of a moving link collides"):
        robot = Robot.from_mjcf(ghost, "a_tip")
    assert robot.capsules.geom == ("a_upper", "a_fore")


def test_a_site_on_the_world_is_refused_with_the_bodies_that_move():
    message = "choose a site or body that moves; bodies with joints: a_upper, a_fore"
    with pytest.raises(RobotError, match=re.escape(message)):
        Robot.from_mjcf(scene(arm("a", 0)), "table")
