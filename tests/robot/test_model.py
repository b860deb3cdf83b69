"""Robots from small MJCFs that each stress the reader, against MuJoCo C in float64."""

import dataclasses
import os
import re
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from rmp_mjx import Robot, RobotError
from rmp_mjx.robot.fingerprint import _LEFT_OUT
from tests import oracles

MOTORS = """<motor joint="a" ctrlrange="-9 9"/><motor joint="b" ctrlrange="-8 8"/>
<motor joint="c" gear="2" ctrlrange="-3 3"/>"""

ODD = f"""<mujoco><option gravity="1 -2 -9"/><worldbody>
<body pos=".1 .2 .3" euler="20 -30 40">
  <joint name="a" type="slide" axis="1 2 2" pos=".1 0 0" armature=".3" ref=".2"/>
  <geom type="box" size=".05 .1 .2" pos="0 .1 .2" euler="0 30 0" mass="2"/>
  <body pos="0 .1 .4" euler="90 0 10">
    <inertial pos=".01 .02 .1" mass="1.5" diaginertia=".03 .02 .01" euler="0 20 0"/>
    <joint name="b" axis="0 1 1" pos="0 .02 -.1" ref="30"
      range="-100 80"/>
    <joint name="c" axis="1 0 -.5" pos=".05 0 0"/>
    <geom type="cylinder" size=".04 .2" pos="0 0 .2"/>
    <body pos="0 0 .4" euler="0 0 50"><geom size=".06" mass=".4"/>
      <site name="tip" pos=".01 .02 .1" euler="15 25 35"/></body>
  </body>
</body></worldbody><actuator>{MOTORS}</actuator></mujoco>"""
"""A rotated base without names, a slide, two joints on one body, offset axes, non-zero
references, a fixed body beyond, tilted gravity, no keyframe, no capsule."""

GRIPPER = f"""<mujoco><compiler angle="radian"/><worldbody><body name="base">
<geom name="foot" type="box" size=".1 .1 .02"/>
<body name="one" pos="0 0 .1"><joint name="a" axis="0 0 1"/>
  <geom name="one" type="capsule" fromto="0 0 0 0 0 .3" size=".04"/>
  <body name="two" pos="0 0 .3"><joint name="b" axis="0 1 0" range="-2 2"/>
    <geom name="two" type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
    <body name="hand" pos=".3 0 0"><joint name="c" axis="1 0 0"/>
      <geom name="hand" size=".05"/><site name="tip" pos=".1 0 0"/>
      <body name="left" pos=".1 .02 0"><joint name="left" type="slide" axis="0 1 0"/>
        <geom name="left" type="box" size=".03 .01 .01"/></body>
      <body name="right" pos=".1 -.02 0"><joint name="right" type="slide" axis="0 1 0"/>
        <geom name="right" type="box" size=".03 .01 .01"/></body>
    </body></body></body></body></worldbody>
<tendon><fixed name="grasp"><joint joint="left" coef="1"/></fixed></tendon>
<equality><joint joint1="left" joint2="right"/></equality>
<actuator>{MOTORS}<position tendon="grasp" kp="10"/></actuator>
<sensor><jointpos joint="left"/></sensor>
<keyframe><key name="home" qpos=".1 .2 .3 .01 .01"/></keyframe></mujoco>"""
"""Fingers off the chain, with all that grippers come with: tendon, equality, sensor."""


@pytest.fixture(scope="module", params=[ODD, GRIPPER], ids=["odd", "gripper"])
def arm(request):
    """An MJCF text and the robot from it."""
    return request.param, Robot.from_mjcf(request.param, site="tip")


def test_kinematics_and_dynamics_equal_mujoco(arm, ours):
    """50 states. 1e-5: the arm's text rounds the MJCF's numbers to six digits."""
    text, robot = arm
    rng = np.random.default_rng(0)
    q, qd = robot.q_ref + rng.uniform(-2, 2, (50, 3)), rng.normal(size=(50, 3))
    terms = ours(robot, q, qd)[0]
    exact = oracles.mujoco_terms(robot.mj_model, "tip", q, qd)
    full = mujoco.MjModel.from_xml_string(text)
    rest = np.tile(full.qpos0[3:], (50, 1))  # fingers locked at the reference
    loose = oracles.mujoco_terms(
        full, "tip", np.hstack([q, rest]), np.hstack([qd, 0.0 * rest])
    )
    chain = loose._replace(
        J=loose.J[..., :3], Mq=loose.Mq[:, :3, :3], bias=loose.bias[:, :3]
    )
    for name, ours_, same, original in zip(
        terms._fields, terms, exact, chain, strict=True
    ):
        np.testing.assert_allclose(ours_, same, rtol=0, atol=1e-11, err_msg=name)
        scale = np.abs(original).max()
        np.testing.assert_allclose(
            ours_, original, rtol=0, atol=1e-5 * scale, err_msg=name
        )


def test_chain_is_read_from_the_file():
    robot = Robot.from_mjcf(ODD, site="tip")
    assert robot.joint_names == ("a", "b", "c")
    assert robot.hinge == (False, True, True)
    assert robot.body_names == ("body_0", "body_1", "body_2")
    assert robot.tau_max.tolist() == [9.0, 8.0, 6.0]  # the last one has a gear of 2
    np.testing.assert_allclose(robot.q_ref, [0.2, np.pi / 6, 0.0], atol=1e-6)
    np.testing.assert_allclose(robot.q_home, robot.q_ref, atol=1e-6)  # no keyframe
    # Degrees in the file, radians here; a joint without a range has infinite limits.
    np.testing.assert_allclose(robot.q_lower[1], np.deg2rad(-100), rtol=1e-5)
    assert np.isinf(robot.q_lower[[0, 2]]).all()
    np.testing.assert_allclose(robot.armature, [0.3, 0.0, 0.0])
    np.testing.assert_allclose(robot.gravity, [1.0, -2.0, -9.0])


def test_fingers_are_locked_and_home_survives():
    robot = Robot.from_mjcf(GRIPPER, site="tip")
    assert robot.joint_names == ("a", "b", "c") and robot.mj_model.nv == 3
    np.testing.assert_allclose(robot.q_home, [0.1, 0.2, 0.3])
    assert "left" in robot.body_names  # still there to be kept off obstacles


def test_a_shorter_chain_ends_at_its_site():
    text = GRIPPER.replace('<geom name="two"', '<site name="elbow"/><geom name="two"')
    robot = Robot.from_mjcf(text, site="elbow")
    assert robot.joint_names == ("a", "b")
    # What hangs on the locked joint moves with the last one.
    np.testing.assert_allclose(
        robot.mass.sum(),
        robot.mj_model.body_mass.sum() - robot.mj_model.body("base").mass,
    )


def test_overrides_replace_what_the_file_says():
    robot = Robot.from_mjcf(
        GRIPPER,
        site="tip",
        joints=["a", "b", "c"],
        links=["one", "hand"],
        armature=[0.1, 0.2, 0.3],
        torque_limits=[1.0, 2.0, 3.0],
    )
    assert robot.body_names == ("one", "hand")
    assert set(robot.points.body) == {"one", "hand"}
    np.testing.assert_allclose(robot.armature, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(robot.mj_model.dof_armature, [0.1, 0.2, 0.3])
    assert robot.tau_max.tolist() == [1.0, 2.0, 3.0]


def test_a_file_with_meshes_loads_from_anywhere(tmp_path):
    """The arm's text finds the mesh also where it is not the working folder."""
    (tmp_path / "assets").mkdir()
    corners = ["0 0 0", ".1 0 0", "0 .1 0", "0 0 .1"]
    faces = ["1 3 2", "1 2 4", "1 4 3", "2 3 4"]
    lines = [f"v {c}" for c in corners] + [f"f {f}" for f in faces]
    (tmp_path / "assets" / "part.obj").write_text("\n".join(lines))
    path = tmp_path / "arm.xml"
    path.write_text(
        """<mujoco><compiler meshdir="assets"/>
        <asset><mesh name="part" file="part.obj"/></asset>
        <worldbody><body name="arm"><joint name="a" axis="0 0 1"/>
        <geom type="mesh" mesh="part"/><site name="tip"/></body></worldbody>
        <actuator><motor joint="a" ctrlrange="-1 1"/></actuator></mujoco>"""
    )
    robot = Robot.from_mjcf(path, site="tip")
    assert robot.mj_model.nmesh == 1 and len(robot.points.segment) > 0


def test_the_robot_is_its_text():
    """Reading `robot.mjcf` again gives the same arm to the last bit."""
    robot = Robot.load(armature="robosuite")
    again = Robot.from_mjcf(
        robot.mjcf, site="grip", q_home=robot.q_home, compensate_passive=False
    )
    assert again == robot and again.fingerprint == robot.fingerprint


MOTOR = '<motor name="drive" joint="shoulder" ctrlrange="-5 5"/>'


def _arm(actuators=MOTOR, joint='<joint name="shoulder"/>'):
    return f"""<mujoco><worldbody><site name="floor"/><body name="arm">{joint}
    <geom name="arm" type="capsule" size=".05 .1"/><site name="tip"/>
    <body name="bare"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>
    </body></worldbody><actuator>{actuators}</actuator></mujoco>"""


REFUSALS = {
    "unknown site": (
        lambda: Robot.from_mjcf(_arm(), site="tipp"),
        "unknown site 'tipp'; valid names: floor, tip. Did you mean 'tip'? Or name a "
        "body, body='bare'; bodies: arm, bare",
    ),
    "unknown joint": (
        lambda: Robot.from_mjcf(_arm(), site="tip", joints=["sholder"]),
        "unknown joint on the chain to 'tip' 'sholder'; valid names: shoulder. "
        "Did you mean 'shoulder'?",
    ),
    "not all joints": (
        lambda: Robot.from_mjcf(_arm(), site="tip", joints=[]),
        "give all of them, base first",
    ),
    "unknown link": (
        lambda: Robot.from_mjcf(_arm(), site="tip", links=["am"]),
        "unknown link with geoms 'am'; valid names: arm. Did you mean 'arm'?",
    ),
    "link without geoms": (
        lambda: Robot.from_mjcf(_arm(), site="tip", links=["bare"]),
        "unknown link with geoms 'bare'; valid names: arm.",
    ),
    "ball joint": (
        lambda: Robot.from_mjcf(
            _arm("", '<joint name="shoulder" type="ball"/>'), site="tip"
        ),
        "joint 'shoulder' is mjJNT_BALL: use hinges and slides",
    ),
    "fixed site": (
        lambda: Robot.from_mjcf(_arm(), site="floor"),
        "no joint between the world and site 'floor', which is on body 'world': choose "
        "a site or body that moves",
    ),
    "no actuator": (
        lambda: Robot.from_mjcf(_arm(""), site="tip"),
        "joint 'shoulder' has 0 actuators: it needs one actuator, or "
        "pass torque_limits=",
    ),
    "two actuators": (
        lambda: Robot.from_mjcf(_arm(MOTOR + MOTOR.replace("drive", "b")), site="tip"),
        "joint 'shoulder' has 2 actuators",
    ),
    "motor without range": (
        lambda: Robot.from_mjcf(
            _arm('<motor name="drive" joint="shoulder"/>'), site="tip"
        ),
        "actuator 'drive' is a motor without ctrlrange or forcerange, so that its "
        "torque limit is unknown: give it one, or pass torque_limits=",
    ),
    "armature of the wrong length": (
        lambda: Robot.from_mjcf(_arm(), site="tip", armature=[1.0, 2.0]),
        "armature must be 1 finite numbers, got [1.0, 2.0]",
    ),
    "torque limits of the wrong length": (
        lambda: Robot.from_mjcf(_arm(), site="tip", torque_limits=[1.0, 2.0]),
        "torque_limits must be 1 finite numbers, got [1.0, 2.0]",
    ),
    "torque limit of zero": (
        lambda: Robot.from_mjcf(_arm(), site="tip", torque_limits=[0.0]),
        "torque_limits must be positive, got [0.0]",
    ),
    "missing file": (
        lambda: Robot.from_mjcf("nowhere/arm.xml", site="tip"),
        "no MJCF file at 'nowhere/arm.xml'",
    ),
    "broken XML": (
        lambda: Robot.from_mjcf("<mujoco><worldbody>", site="tip"),
        "MuJoCo cannot read the MJCF",
    ),
    "physics that does not compile": (
        lambda: Robot.from_mjcf(_arm(MOTOR.replace("shoulder", "x")), site="tip"),
        "MuJoCo cannot compile the MJCF",
    ),
    "unknown robot": (
        lambda: Robot.load("jaco3"),
        "unknown robot 'jaco3'; valid names: jaco2, panda, fr3, ur5e, iiwa14, planar3",
    ),
    "unknown armature setting": (
        lambda: Robot.load(armature="physcal"),
        "unknown armature setting 'physcal'; valid names: physical, robosuite. "
        "Did you mean 'physical'?",
    ),
}


@pytest.mark.parametrize(("attempt", "message"), REFUSALS.values(), ids=REFUSALS.keys())
def test_bad_input_gets_a_clear_error(attempt, message):
    with pytest.raises(RobotError, match=re.escape(message)):
        attempt()


@pytest.mark.parametrize("spacing", [0.0, -0.01, float("nan")])
def test_spacing_must_be_positive(spacing):
    with pytest.raises(ValueError, match="spacing must be positive"):
        Robot.load(spacing=spacing)


def test_a_motor_may_be_limited_by_force_instead_of_control():
    text = _arm('<motor joint="shoulder" gear="3" forcerange="-4 4"/>')
    assert Robot.from_mjcf(text, site="tip").tau_max.tolist() == [12.0]


def test_the_joint_itself_may_limit_the_force():
    text = _arm(joint='<joint name="shoulder" actuatorfrcrange="-2 2"/>')
    assert Robot.from_mjcf(text, site="tip").tau_max.tolist() == [2.0]


def test_torque_limits_stand_in_for_missing_actuators():
    robot = Robot.from_mjcf(_arm(""), site="tip", torque_limits=[7.0])
    assert robot.tau_max.tolist() == [7.0]


CHANGES = {
    "q_home": lambda robot: robot.replace(q_home=robot.q_home + 1e-6),
    "mass": lambda robot: robot.replace(mass=robot.mass * 1.001),
    "points": lambda robot: Robot.load(spacing=0.02),
    "armature": lambda robot: Robot.load(armature="robosuite"),
    "joint names": lambda robot: robot.replace(joint_names=robot.joint_names[::-1]),
    "hinge": lambda robot: robot.replace(hinge=(False,) * 7),
    "damping": lambda robot: Robot.load(compensate_passive=True),
    "capsule pairs": lambda robot: robot.replace(
        capsules=robot.capsules.replace(pairs=robot.capsules.pairs[:-1])
    ),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_another_arm_has_another_fingerprint(robot, change):
    assert change(robot).fingerprint != robot.fingerprint


def test_every_field_but_the_text_counts(robot):
    left_out = {f.name for f in dataclasses.fields(robot)} & _LEFT_OUT
    assert left_out == {"mjcf", "assets", "name"}


def test_how_the_arm_is_written_does_not_count(robot):
    assert len(robot.fingerprint) == 32 and int(robot.fingerprint, 16)
    rewritten = robot.replace(mjcf="<!-- a note -->" + robot.mjcf, name="other")
    assert rewritten.fingerprint == robot.fingerprint
    last_bit = robot.replace(mass=np.nextafter(robot.mass, 9.0))
    assert last_bit.fingerprint == robot.fingerprint
    negative_zero = robot.replace(site_offset=-0.0 + robot.site_offset)
    assert negative_zero.fingerprint == robot.fingerprint


def test_it_is_the_same_in_another_process(robot):
    code = "from rmp_mjx import Robot; print(Robot.load().fingerprint)"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONHASHSEED": "7"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == robot.fingerprint


def test_a_robot_prints_on_one_line(robot):
    expected = "Robot('jaco2', 7 joints to site 'grip', 59 control points)"
    assert repr(robot) == expected
