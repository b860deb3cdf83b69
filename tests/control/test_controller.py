"""Every controller fulfils the protocol and answers in the same form."""

from typing import Any

import jax
import jax.numpy as jnp
import pytest

from rmp_mjx import RMPVICES, VICES, Controller, Obstacles, Robot, rmp_vices_literal
from rmp_mjx.control.cbf import FilteredVICES
from rmp_mjx.control.osc import OSC
from tests.envs.arm_tasks import Torques
from tests.robot.test_model import GRIPPER

MAKE = {
    "rmp_vices": RMPVICES,
    "vices": VICES,
    "vices_cbf": FilteredVICES,
    "osc": OSC,
    "rmp_vices_literal": rmp_vices_literal,
}


@pytest.fixture(scope="module")
def robot():
    return Robot.from_mjcf(GRIPPER, site="tip", spacing=0.1)


@pytest.mark.parametrize("name", MAKE)
def test_controllers_have_one_interface(robot, name):
    ctrl = MAKE[name](robot)
    assert isinstance(ctrl, Controller)
    near = Obstacles.empty(spheres=1, planes=1)

    def step(q, policy, time):
        setpoint = ctrl.setpoint(q, ctrl.decode(policy), time)
        return ctrl(q, q, setpoint, near)

    out = jax.eval_shape(step, jnp.zeros(3), jnp.zeros(12), 0.0)
    assert out.diagnostics["torque_scale"].shape == ()
    assert [x.shape for x in (out.tau, out.qdd, out.f)] == [(3,)] * 3
    assert out.M.shape == (3, 3)
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(out))


def test_a_controller_of_ones_own_needs_no_base_class(robot):
    assert isinstance(Torques(jnp.zeros(7)), Controller)
    assert not isinstance(robot, Controller)


def test_the_time_of_the_policy_step_must_be_given(robot):
    ctrl: Any = VICES(robot)
    action = ctrl.decode(jnp.zeros(12))
    with pytest.raises(TypeError, match="'time'"):
        ctrl.setpoint(jnp.zeros(3), action)
    assert ctrl.setpoint(jnp.zeros(3), action, 2).time == 2.0
