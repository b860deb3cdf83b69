"""Every controller fulfils the protocol and answers in the same form."""

from typing import Any

import jax
import jax.numpy as jnp
import pytest

from rmp_mjx import (
    RMPVICES,
    VICES,
    Controller,
    Leaves,
    Obstacles,
    Robot,
    rmp_vices_literal,
)
from rmp_mjx.control.cbf import FilteredVICES
from rmp_mjx.control.vices import OSC
from rmp_mjx.rmp.leaves import collision_near, collision_transit
from rmp_mjx.shapes import KINDS
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


def test_a_controller_has_the_default_leaves_unless_it_is_given_others(robot):
    assert RMPVICES(robot) == RMPVICES(robot, Leaves.default(robot))
    assert RMPVICES(robot, Leaves()).leaves == Leaves()
    assert RMPVICES(robot, Leaves()) != RMPVICES(robot)


def test_one_kind_of_obstacle_gets_its_own_leaf_and_the_others_keep_theirs(robot):
    ctrl = RMPVICES(robot).with_collision({"spheres": collision_transit()})
    ctrl = ctrl.with_collision({"boxes": None})
    assert ctrl.leaves.collision == {
        "spheres": collision_transit(),
        "planes": collision_near(),
        "capsules": collision_near(),
        "boxes": None,
    }
    assert ctrl.leaves.self_collision == RMPVICES(robot).leaves.self_collision
    assert ctrl.with_collision(None).leaves.collision is None


def test_a_leaf_for_each_kind_must_be_complete():
    with pytest.raises(ValueError, match="no leaf for planes, capsules, boxes"):
        Leaves(collision={"spheres": collision_near()})
    Leaves(collision=dict.fromkeys(KINDS.values()))
