"""Dampers and springs of the joints, which the controllers make up for."""

import functools
import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rmp_mjx import RMPVICES, VICES, Action, Obstacles, Robot, RobotWarning

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
