"""Every controller fulfils the protocol and answers in the same form."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
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
from rmp_mjx.control.contact import ContactResponse
from rmp_mjx.control.vices import OSC
from rmp_mjx.rmp.leaves import collision_near, collision_transit
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state, site_state
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
    assert out.diagnostics["torque_limit"].shape == (3,)
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


Q, QD = np.array([0.1, 0.5, -0.3]), np.array([0.4, -0.2, 0.3])
ACTION = np.full(12, 0.3)
FAR = [1e4, 0.0, 0.0]
"""The leaf has no range: its metric falls with the fourth power of the distance."""


@pytest.fixture(scope="module")
def literal():
    return rmp_vices_literal(Robot.from_mjcf(GRIPPER, site="tip", spacing=0.1))


@pytest.fixture(scope="module")
def act(literal):
    """Output, site, inertia and limiter's metric; float64."""

    @jax.jit
    def run(q, qd, center):
        slots = Obstacles.empty(spheres=1).with_spheres(center[None], 0.05)
        setpoint = literal.setpoint(q, literal.decode(ACTION), 0.0)
        arm = arm_state(literal.robot, q, qd)
        out = literal(q, qd, setpoint, slots)
        Mq, _ = dynamics(literal.robot, arm)
        limiter = literal.leaves.joint_limit.scalar(q, qd)[1]
        return out, site_state(literal.robot, arm), Mq, limiter

    def call(qd, center):
        with jax.enable_x64(True):
            return jax.device_get(run(Q, np.asarray(qd), np.asarray(center)))

    return call


def test_far_from_everything_the_root_is_attractors_and_limiter(act):
    """1e-12: rounding. The limiter stands on the limited joints' diagonal alone."""
    out, site, _, limiter = act(QD, FAR)
    rest = out.M - site.J_pos.T @ site.J_pos - site.J_ori.T @ site.J_ori
    np.testing.assert_allclose(rest, np.diag(limiter), atol=1e-12)
    np.testing.assert_array_equal(limiter > 0, [False, True, False])


def test_obstacle_weighs_nothing_at_rest_however_near(act):
    """Why a slow push wins: the metric vanishes with the speed."""
    near, far = [0.3, 0.0, 0.4], FAR
    still = np.zeros(3)
    assert act(still, near)[0].diagnostics["clearance"] < 0.1
    np.testing.assert_array_equal(act(still, near)[0].M, act(still, far)[0].M)
    moving, free = act(QD, near)[0].M, act(QD, far)[0].M
    assert np.abs(moving - free).max() > 1.0


def test_acceleration_is_the_roots_up_to_its_regulariser(literal, act):
    """`REGULARIZER` Mq against a root of order one."""
    out, _, Mq, _ = act(QD, FAR)
    np.testing.assert_allclose(
        (out.M + literal.regularizer * Mq) @ out.qdd, out.f, rtol=1e-6, atol=1e-6
    )
    np.testing.assert_allclose(out.M @ out.qdd, out.f, atol=1e-3 * np.abs(out.f).max())


def test_results_depend_on_these_default_numbers(robot):
    """Whoever changes one of them has to renew the results."""
    ctrl, literal = RMPVICES(robot), rmp_vices_literal(robot)
    assert (ctrl.attractor_weight, ctrl.regularizer) == (1.0, 1e-3)
    assert (ctrl.braking_share, ctrl.period) == (0.7, 0.005)
    assert literal.regularizer == 1e-5
    contact = ContactResponse()
    assert (contact.cap, contact.near) == (50.0, 0.02)
    assert (contact.release, contact.min_weight) == (10.0, 0.01)
    assert (VICES(robot).kq, OSC(robot).kp) == (10.0, 150.0)
