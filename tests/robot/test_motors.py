"""Whatever actuators a file has, the robot's own model has one torque motor a joint."""

import functools
import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rmp_mjx import RMPVICES, VICES, Action, Obstacles, Robot, RobotError, RobotWarning

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
}


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


JOINTS = {
    "a": 'damping="3" stiffness="20" springref="0.4"',
    "b": 'type="slide" damping="40"',
    "c": 'stiffness="5" springref="-0.2" ref="0.1"',
}


def text(**joints):
    a, b, c = (f'name="{k}" {(JOINTS | joints)[k]}' for k in "abc")
    return f"""<mujoco><compiler angle="radian"/><worldbody><body name="one">
    <joint {a} axis="0 1 0" range="-2 2" armature=".05"/>
    <geom name="one" type="capsule" fromto="0 0 0 0 0 .3" size=".04"/>
    <body name="two" pos="0 0 .3"><joint {b} axis="1 0 0" range="-.3 .3"/>
    <geom name="two" type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
    <body name="three" pos=".3 0 0"><joint {c} axis="0 0 1" armature=".02"/>
    <geom name="three" type="capsule" fromto="0 0 0 0 .2 0" size=".03"/>
    <site name="tip" pos="0 .2 0"/></body></body></body></worldbody><actuator>
    <motor joint="a" ctrlrange="-90 90"/><motor joint="b" ctrlrange="-90 90"/>
    <motor joint="c" ctrlrange="-90 90"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def sprung():
    """A hinge with both, a slide with a damper, a hinge with a spring and a ref."""
    return Robot.from_mjcf(text(), site="tip", spacing=0.1)


def test_bias_balances_mujocos_passive_forces(sprung, ours):
    """qfrc_bias - qfrc_passive in 50 states, float64; 1e-11 of 100 N m."""
    rng = np.random.default_rng(0)
    q, qd = rng.uniform(-2, 2, (50, 3)), rng.normal(scale=2.0, size=(50, 3))
    bias = ours(sprung, q, qd)[0].bias
    model = sprung.mj_model
    data = mujoco.MjData(model)
    for k in range(50):
        data.qpos[:], data.qvel[:] = q[k], qd[k]
        mujoco.mj_forward(model, data)
        assert np.abs(data.qfrc_passive).min() > 0.0
        expected = data.qfrc_bias - data.qfrc_passive
        np.testing.assert_allclose(bias[k], expected, rtol=0.0, atol=1e-11)


def test_it_is_a_choice(sprung, ours):
    """Without it the bias is MuJoCo's qfrc_bias alone."""
    robot = Robot.from_mjcf(text(), site="tip", spacing=0.1, compensate_passive=False)
    assert robot.damping is None and robot.stiffness is None
    q, qd = np.full((1, 3), 0.3), np.full((1, 3), 0.5)
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:], data.qvel[:] = q[0], qd[0]
    mujoco.mj_forward(robot.mj_model, data)
    bias = ours(robot, q, qd)[0].bias[0]
    np.testing.assert_allclose(bias, data.qfrc_bias, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("controller", [RMPVICES, functools.partial(VICES, kq=0.0)])
def test_every_controller_gives_the_passive_forces_on_top(sprung, controller):
    """The torque differs by damping and springs; 1e-4 of 100 N m, in float32. Three
    joints cannot do all that VICES asks of a hand, and its solves would multiply the
    rounding. So no orientation is held, and no posture."""
    bare = sprung.replace(damping=None, stiffness=None, spring_ref=None)
    q, qd = jnp.array([0.2, 0.05, 0.3]), jnp.array([0.3, -0.1, 0.2])
    action = Action(jnp.zeros(3), jnp.zeros(3), jnp.full(3, 50.0), jnp.zeros(3))
    torques = []
    for robot in (sprung, bare):
        ctrl = controller(robot)
        setpoint = ctrl.setpoint(q, action, 0.0)
        out = jax.jit(ctrl)(q, qd, setpoint, Obstacles.empty())
        assert not out.diagnostics["torque_limit"].any()
        torques.append(out.tau)
    expected = [3 * 0.3 + 20 * (0.2 - 0.4), 40 * -0.1, 5 * (0.3 + 0.2)]
    np.testing.assert_allclose(torques[0] - torques[1], expected, atol=1e-4)


def test_an_arm_without_them_has_no_such_arrays():
    """None, so that the program of a controller is the one without the terms."""
    robot = Robot.from_mjcf(text(a="", b='type="slide"', c=""), site="tip")
    assert robot.damping is robot.stiffness is robot.spring_ref is None
    shipped = Robot.load()
    assert shipped.damping is shipped.stiffness is None
    compensated = Robot.load(compensate_passive=True)
    np.testing.assert_array_equal(compensated.damping, [0.1] * 5 + [0.01] * 2)
    assert compensated.stiffness is None


@pytest.mark.parametrize(
    ("joint", "message"),
    [
        ('damping="3" frictionloss="1.5"', r"joints \['a'\] have dry friction"),
        ('damping="1 2"', r"joints \['a'\] have polynomial damping or stiffness"),
        ('stiffness="1 2"', r"joints \['a'\] have polynomial damping or stiffness"),
    ],
)
def test_what_cannot_be_compensated_is_named(joint, message):
    with pytest.warns(RobotWarning, match=message) as caught:
        Robot.from_mjcf(text(a=joint), site="tip", spacing=0.1)
    assert len(caught) == 1
    assert caught[0].filename == __file__  # the caller's line


def test_a_file_without_friction_warns_of_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Robot.from_mjcf(text(), site="tip", spacing=0.1)


def test_gravity_compensation_is_left_out_with_a_warning(ours):
    """The controllers carry the whole weight; so must the simulation."""
    floating = text().replace('<body name="two"', '<body name="two" gravcomp="1"')
    with pytest.warns(RobotWarning, match=r"bodies \['two'\] have gravcomp"):
        robot = Robot.from_mjcf(floating, site="tip", spacing=0.1)
    data = mujoco.MjData(robot.mj_model)
    mujoco.mj_forward(robot.mj_model, data)
    np.testing.assert_array_equal(data.qfrc_gravcomp, 0.0)
