"""Whatever actuators a file has, the robot's own model has one torque motor a joint."""

import mujoco
import numpy as np
import pytest

from rmp_mjx import Robot, RobotError, RobotWarning

ARM = """<mujoco><compiler angle="radian"/><option gravity="0 0 0"/>
<default><general ctrlrange="-1 1" gear="7" biastype="affine" biasprm="0 -3 -2"/>
</default><worldbody><body name="one">
<joint name="a" axis="0 0 1"/><geom name="one" type="capsule" size=".05 .1"/>
<body name="two" pos="0 0 .3"><joint name="b" axis="0 1 0" {joint}/>
<geom name="two" type="capsule" size=".04 .1"/><site name="tip" pos="0 0 .1"/></body>
</body></worldbody><actuator>{actuators}</actuator></mujoco>"""
"""Two joints; a default class that would spoil every actuator added carelessly."""

FIRST = '<motor name="first" joint="a" ctrlrange="-5 5" gear="1"/>'


def arm(second, first=FIRST, joint="", **kwargs):
    text = ARM.format(actuators=first + second, joint=joint)
    return Robot.from_mjcf(text, site="tip", **kwargs)


def applied(robot, ctrl):
    """Torques that MuJoCo applies, moving and away from zero."""
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = 0.3, 0.7, ctrl
    mujoco.mj_forward(robot.mj_model, data)
    return data.qfrc_actuator


ACCEPTED = {
    "motor": ('<motor name="s" joint="b" gear="1" ctrlrange="-4 4"/>', 4.0),
    "motor with a gear": ('<motor name="s" joint="b" gear="3" ctrlrange="-4 4"/>', 12),
    "motor that turns back": (
        '<motor name="s" joint="b" gear="-3" ctrlrange="-4 5"/>',
        12.0,
    ),
    "motor that only turns back": (
        '<motor name="s" joint="b" gear="-1" ctrlrange="-4 4"/>',
        4.0,
    ),
    "gain that turns back": (
        '<general name="s" joint="b" gainprm="-1" biastype="none" gear="1" '
        'ctrlrange="-4 4"/>',
        4.0,
    ),
    "gain": (
        '<general name="s" joint="b" gainprm="2" biastype="none" gear="1" '
        'ctrlrange="-4 4"/>',
        8.0,
    ),
    "gain by position": (
        '<general name="s" joint="b" gaintype="affine" gainprm="1 .5" biastype="none" '
        'gear="1" ctrlrange="-6 6" forcerange="-6 6"/>',
        6.0,
    ),
    "motor with a force range": (
        '<motor name="s" joint="b" gear="2" ctrlrange="-4 4" forcerange="-3 3"/>',
        6.0,
    ),
    "uneven range": ('<motor name="s" joint="b" gear="1" ctrlrange="-4 9"/>', 4.0),
    "position": (
        '<position name="s" joint="b" kp="9" kv="2" gear="1" forcerange="-6 6"/>',
        6.0,
    ),
    "velocity": (
        '<velocity name="s" joint="b" kv="9" gear="2" forcerange="-6 6"/>',
        12.0,
    ),
    "integrated velocity": (
        '<intvelocity name="s" joint="b" kp="9" gear="1" forcerange="-6 6" '
        'actrange="-1 1"/>',
        6.0,
    ),
    "in the parent's frame": (
        '<motor name="s" jointinparent="b" gear="1" ctrlrange="-4 4"/>',
        4.0,
    ),
    "gain that a force range undoes": (
        '<general name="s" joint="b" gainprm="2" biastype="none" gear="1" '
        'ctrlrange="-4 4" forcerange="-4 4"/>',
        4.0,
    ),
    "gear that a force range undoes": (
        '<motor name="s" joint="b" gear="2" ctrlrange="-4 4" forcerange="-2 2"/>',
        4.0,
    ),
    "control without a range": (
        '<motor name="s" joint="b" gear="1" ctrllimited="false" ctrlrange="-4 4" '
        'forcerange="-4 4"/>',
        4.0,
    ),
    "uneven the other way": (
        '<motor name="s" joint="b" gear="1" ctrlrange="-9 4"/>',
        4.0,
    ),
    "position with a gain of 1": (
        '<position name="s" joint="b" kp="1" gear="1" ctrlrange="-6 6" '
        'forcerange="-6 6"/>',
        6.0,
    ),
    "weak position": (
        '<position name="s" joint="b" kp="2" gear="1" forcerange="-6 6"/>',
        6.0,
    ),
    "weak gain by position": (
        '<general name="s" joint="b" gaintype="affine" gainprm="1 .5" biastype="none" '
        'gear="1" dyntype="filter" dynprm=".1" forcerange="-6 6"/>',
        6.0,
    ),
    "rotor inertia": (
        '<motor name="s" joint="b" gear="1" ctrlrange="-4 4" armature=".1"/>',
        4.0,
    ),
    "damping": (
        '<motor name="s" joint="b" gear="1" ctrlrange="-4 4" damping=".1"/>',
        4.0,
    ),
    "delay": (
        '<motor name="s" joint="b" gear="1" ctrlrange="-4 4" nsample="3" '
        'delay=".004"/>',
        4.0,
    ),
}


@pytest.mark.filterwarnings("error::rmp_mjx.RobotWarning")
@pytest.mark.parametrize(("text", "limit"), ACCEPTED.values(), ids=ACCEPTED.keys())
def test_control_is_torque_up_to_the_limit(text, limit):
    robot = arm(text)
    assert robot.tau_max.tolist() == [5.0, limit]
    model = robot.mj_model
    assert [model.actuator(k).name for k in range(model.nu)] == ["first", "s"]
    assert model.na == 0
    np.testing.assert_array_equal(applied(robot, [1.5, -2.5]), [1.5, -2.5])
    np.testing.assert_array_equal(applied(robot, [99, -99]), [5.0, -limit])
    assert not model.actuator_gear[:, 1:].any()  # of six gears a hinge has one
    assert [a.nsample for a in robot.mj_spec.actuators] == [0, 0]


@pytest.mark.parametrize("name", ACCEPTED)
def test_only_a_file_of_such_motors_stays_as_it_is(name):
    """A motor that replaces another one is in no group."""
    text = ACCEPTED[name][0].replace('name="s"', 'name="s" group="3"')
    robot = arm(text, first=FIRST.replace("/>", ' group="3"/>'))
    group = 3 if name == "motor" else 0
    assert robot.mj_model.actuator_group.tolist() == [group, group]


def test_the_joint_may_limit_a_position_actuator():
    robot = arm(
        '<position name="s" joint="b" kp="9" gear="1"/>',
        joint='actuatorfrcrange="-2 2"',
    )
    assert robot.tau_max.tolist() == [5.0, 2.0]


@pytest.mark.parametrize(("own", "limit"), [(3, 3.0), (6, 4.0)])
def test_the_narrower_of_two_limits_counts(own, limit):
    motor = '<motor name="s" joint="b" gear="1" ctrlrange="-4 4"/>'
    robot = arm(motor, joint=f'actuatorfrcrange="-{own} {own}"')
    assert robot.tau_max.tolist() == [5.0, limit]


def test_a_joint_without_an_actuator_may_have_a_limit_of_its_own():
    robot = arm("", joint='actuatorfrcrange="-2 3"')
    assert robot.tau_max.tolist() == [5.0, 2.0]
    with pytest.raises(RobotError, match="joint 'b' has 0 actuators: it needs one"):
        arm("", joint='actuatorfrcrange="0 3"')


def test_two_actuators_of_one_joint_are_not_one_of_each():
    """They stand in their order, with the limits given: neither is the other's."""
    second = '<motor name="s" joint="b" gear="1" ctrlrange="-7 7"/>'
    for first in (FIRST, FIRST.replace('joint="a"', 'joint="b"')):
        third = second.replace('"s"', '"t"')
        robot = arm(second + third, first=first, torque_limits=[5.0, 7.0])
        assert robot.mj_model.nu == 2
        np.testing.assert_array_equal(applied(robot, [99, -99]), [5.0, -7.0])
    robot = arm(second + third, torque_limits=[5.0, 7.0])
    names = [robot.mj_model.actuator(k).name for k in range(2)]
    assert names == ["first", ""]


@pytest.mark.parametrize(
    "second",
    [
        "",
        '<position name="s" joint="b" kp="9" forcerange="-6 6"/>',
        '<motor name="s" joint="b" gear="3" ctrlrange="-1 1"/>',
        '<motor name="s" joint="b" ctrlrange="-1 1"/><damper name="d" joint="b" '
        'kv="1" ctrlrange="0 1"/>',
    ],
    ids=["none", "position", "motor", "two"],
)
def test_torque_limits_replace_all_that_the_file_says(second):
    robot = arm(second, joint='actuatorfrcrange="-2 2"', torque_limits=[8.0, 7.0])
    assert robot.tau_max.tolist() == [8.0, 7.0]
    np.testing.assert_array_equal(applied(robot, [99, -6.5]), [8.0, -6.5])


def test_motors_come_in_the_order_of_the_joints():
    """A controller's torques are the controls, one by one."""
    second = '<motor name="s" joint="b" gear="1" ctrlrange="-4 4"/>'
    robot = arm(FIRST, first=second)
    assert robot.tau_max.tolist() == [5.0, 4.0]
    np.testing.assert_array_equal(applied(robot, [1.5, -2.5]), [1.5, -2.5])


def test_rotor_inertia_and_damping_of_an_actuator_pass_to_its_joint():
    text = (
        '<position name="s" joint="b" kp="9" gear="2" forcerange="-6 6" '
        'armature=".5" damping=".25"/>'
    )
    robot = arm(text, joint='armature=".1" damping="1"')
    np.testing.assert_allclose(robot.armature, [0.0, 0.1 + 4 * 0.5])
    np.testing.assert_allclose(np.asarray(robot.damping), [0.0, 1.0 + 4 * 0.25])
    original = mujoco.MjModel.from_xml_string(
        ARM.format(actuators=FIRST + text, joint='armature=".1" damping="1"')
    )
    inertia = []
    for model in (original, robot.mj_model):
        data, Mq = mujoco.MjData(model), np.zeros((2, 2))
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, Mq)
        inertia.append(Mq)
    # The arm's text has six digits.
    np.testing.assert_allclose(inertia[1], inertia[0], rtol=1e-5)


@pytest.mark.filterwarnings("ignore:.*polynomial:rmp_mjx.RobotWarning")
@pytest.mark.parametrize("gear", [2.0, -3.0])
def test_an_actuators_damping_slows_the_arm_as_before(gear):
    """Linear, square and cubic, by MuJoCo C; the arm's text has six digits."""
    text = (
        f'<motor name="s" joint="b" gear="{gear}" ctrlrange="-6 6" '
        'damping=".25 .5 .125"/>'
    )
    robot, slowed = arm(text, joint='damping="1 .1 .2"'), []
    original = ARM.format(actuators=FIRST + text, joint='damping="1 .1 .2"')
    for model in (mujoco.MjModel.from_xml_string(original), robot.mj_model):
        data = mujoco.MjData(model)
        data.qvel[:] = 0.7, -0.6
        mujoco.mj_forward(model, data)
        slowed.append(data.qacc.copy())
    np.testing.assert_allclose(slowed[1], slowed[0], rtol=1e-5)


def test_a_motor_with_dynamics_loses_them_with_a_warning():
    text = (
        '<general name="s" joint="b" gear="1" biastype="none" dyntype="filter" '
        'dynprm=".1" ctrlrange="-4 4"/>'
    )
    with pytest.warns(RobotWarning, match="motor 's' has activation dynamics"):
        robot = arm(text)
    assert robot.mj_model.na == 0


REFUSED = {
    "position without a force range": (
        '<position name="s" joint="b" kp="9" ctrlrange="-1 1"/>',
        "actuator 's' is a position actuator without forcerange, so that its "
        "torque limit is unknown: give it one, or pass torque_limits=",
    ),
    "velocity without a force range": (
        '<velocity name="s" joint="b" kv="9"/>',
        "actuator 's' is a velocity actuator without forcerange",
    ),
    "general without a force range": (
        '<general name="s" joint="b" gaintype="affine" gainprm="1 .5" '
        'biastype="none"/>',
        "actuator 's' is a general actuator without forcerange",
    ),
    "motor without a range": (
        '<motor name="s" joint="b" gear="1" ctrllimited="false"/>',
        "actuator 's' is a motor without ctrlrange or forcerange",
    ),
    "motor without a name": (
        '<motor joint="b" gear="1" ctrllimited="false"/>',
        "actuator 'on joint b' is a motor without",
    ),
    "none": ("", "joint 'b' has 0 actuators: it needs one"),
    "one way and never still": (
        '<motor name="s" joint="b" gear="1" ctrlrange="1 4"/>',
        r"actuator 's' cannot push both ways: its torque range is \[1, 4\]",
    ),
    "the other way": (
        '<motor name="s" joint="b" gear="1" ctrlrange="-4 -1"/>',
        r"actuator 's' cannot push both ways: its torque range is \[-4, -1\]",
    ),
    "one way": (
        '<motor name="s" joint="b" gear="1" ctrlrange="0 4"/>',
        r"actuator 's' cannot push both ways: its torque range is \[0, 4\]",
    ),
    "several": (
        '<motor name="s" joint="b" ctrlrange="-1 1"/>'
        '<motor name="t" joint="b" ctrlrange="-1 1"/>',
        r"joint 'b' has 2 actuators \('s', 't'\): it needs one",
    ),
}


@pytest.mark.parametrize(("text", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_a_refusal_says_which_actuator_and_what_it_needs(text, message):
    with pytest.raises(RobotError, match=message):
        arm(text)
