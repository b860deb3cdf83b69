"""Every refusal of `Robot.from_mjcf` names what is wrong and what would be right."""

import re

import pytest

from rmp_mjx import Robot, RobotError

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
        "unknown robot 'jaco3'; valid names: jaco2. Did you mean 'jaco2'?",
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
