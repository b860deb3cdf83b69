"""Files as people have them: URDF, two arms, mimic joints, nothing that collides."""

import re
import warnings
from pathlib import Path

import mujoco
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
<origin xyz="0 0 .2"/><axis xyz="0 1 0"/><limit effort="10" velocity=".3"/></joint>
</robot>"""


def test_a_urdf_brings_its_limits_and_its_continuous_joints(tmp_path):
    """A cylinder's capsule has its radius and a little more: the polygon round it."""
    path = tmp_path / "two.urdf"
    path.write_text(URDF)
    robot = Robot.load(str(path), body="tip")
    assert robot.joint_names == ("a", "b") and robot.tau_max.tolist() == [30.0, 10.0]
    np.testing.assert_array_equal(robot.qd_max, [2.0, 0.3])
    np.testing.assert_allclose(robot.q_lower, [-1.0, -np.inf])
    assert 0.04 < robot.capsules.radius[0] < 0.055
    for unknown in ("", 'velocity="0"', 'velocity="-3"'):
        path.write_text(URDF.replace('velocity=".3"', unknown))
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
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        free = Robot.from_mjcf(hand, "a_tip")
    assert coupled.joint_names == free.joint_names
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


@pytest.mark.parametrize(
    ("more", "equality"),
    [
        ('<body name="a2"><geom size=".01"/></body>', '<weld body1="a2"/>'),
        ("", '<tendon tendon1="a2"/>'),
    ],
    ids=["a body", "a tendon"],
)
def test_what_only_has_the_name_of_a_joint_couples_nothing(more, equality):
    tendon = '<tendon><fixed name="a2"><joint joint="a1" coef="1"/></fixed></tendon>'
    rest = f"{tendon}<equality>{equality}</equality>"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        robot = Robot.from_mjcf(scene(arm("a", 0, more=more), rest), "a_tip")
    assert robot.mj_model.neq == 0


@pytest.mark.parametrize("joints", [["b2", "b1"], ["b1"], ["a1", "b2"]])
def test_the_joints_of_a_chain_are_all_of_them_in_their_order(joints):
    with pytest.raises(RobotError, match="joint"):
        Robot.from_mjcf(scene(arm("b", 0)), "b_tip", joints=joints)
    assert Robot.from_mjcf(scene(arm("b", 0)), "b_tip", joints=["b1", "b2"]).n == 2


def test_the_chain_goes_on_to_the_world_whatever_its_bodies_are_called():
    """Bodies before and after the world in the alphabet; the latter is a base."""
    text = scene(arm("zeta", 0) + arm("alpha", 1))
    assert Robot.from_mjcf(text, "zeta_tip").joint_names == ("zeta1", "zeta2")
    assert Robot.from_mjcf(text, "alpha_tip").joint_names == ("alpha1", "alpha2")


@pytest.mark.parametrize("first", ["above", "zero"])
def test_the_posture_is_the_keyframe_called_home(first):
    keys = f'<key name="{first}" qpos="1 1"/><key name="home" qpos=".2 .3"/>'
    rest = f"<keyframe>{keys}</keyframe>"
    robot = Robot.from_mjcf(scene(arm("a", 0), rest), "a_tip")
    np.testing.assert_allclose(robot.q_home, [0.2, 0.3])


def test_an_arm_is_called_as_its_model_or_as_its_file(tmp_path):
    text, named = scene(arm("a", 0)), '<mujoco model="{}">'
    path = tmp_path / "own.xml"
    path.write_text(text)
    assert Robot.from_mjcf(path, "a_tip").name == "own"
    assert Robot.from_mjcf(str(path), "a_tip").name == "own"
    assert Robot.from_mjcf(text, "a_tip").name == "arm"
    assert Robot.from_mjcf(mujoco.MjSpec.from_string(text), "a_tip").name == "arm"
    for name in ("Alpha", "zeta"):
        path.write_text(text.replace("<mujoco>", named.format(name)))
        assert Robot.from_mjcf(path, "a_tip").name == name


CORNERS = ("0 0 0", ".1 0 0", "0 .1 0", "0 0 .1")
FACES = ("1 3 2", "1 2 4", "1 4 3", "2 3 4")
MESH = "\n".join([f"v {c}" for c in CORNERS] + [f"f {f}" for f in FACES])


@pytest.mark.parametrize("folders", [("b", "c"), ("c", "b")])
def test_files_of_an_attached_hand_are_found_in_its_own_folder(tmp_path, folders):
    """Before or after the arm's in the alphabet; the arm's own keep their names."""
    specs = []
    for folder, name in zip(folders, ("hand", "a"), strict=True):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / f"{name}.obj").write_text(MESH)
        mesh = f'<asset><mesh name="{name}" file="{name}.obj"/></asset><worldbody>'
        text = f'<mujoco><compiler meshdir="{tmp_path / folder}"/>{mesh}'
        geom = f'<body name="{name}_part"><geom type="mesh" mesh="{name}"/></body>'
        own = arm("a", 0, more=geom) if name == "a" else geom
        rest = scene(own).split("<worldbody>")[1]
        specs.append(mujoco.MjSpec.from_string(text + rest))
    hand, spec = specs
    spec.attach(hand, prefix="x/", frame=spec.body("a_fore").add_frame())
    robot = Robot.from_mjcf(spec, "a_tip")
    assert robot.mj_model.nmesh == 2
    files = {mesh.name: mesh.file for mesh in robot.mj_spec.meshes}
    assert files["a"] == "a.obj" and Path(files["x/hand"]).is_absolute()


def test_what_stands_in_the_world_is_no_part_of_the_arm():
    """Not the floor; a base that does not move is, and a body without mass weighs
    nothing and has its centre on its joint."""
    floor = '<geom name="floor" size="9" pos="0 0 -9"/>'
    base = '<body name="base"><geom name="base" size=".1"/></body>'
    more = '<joint name="a0" axis="1 0 0" pos="0 .1 0"/><joint name="a1"'
    text = scene(floor + base + arm("a", 0).replace('<joint name="a1"', more))
    robot = Robot.from_mjcf(text, "a_tip")
    assert robot.capsules.geom == ("base", "a_upper", "a_fore")
    assert robot.capsules.segment == (-1, 1, 2)
    assert robot.mass[0] == 0.0 and robot.mass[1] > 0.0
    np.testing.assert_array_equal(robot.com[0], 0.0)
