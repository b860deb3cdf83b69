"""What the tree does with the contacts' torque."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rmp_mjx import RMPVICES, Obstacles
from rmp_mjx.control.contact import ContactResponse, turning_by_contact
from rmp_mjx.rmp.leaves import collision_near
from rmp_mjx.rmp.leaves.joint_limit import JointLimitBarrier, RMPflowJointLimit
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state, site_state

N = 7


def test_a_distance_leaf_adds_what_contacts_take_from_it():
    """f grows by m times the acceleration towards the body; away from it by nothing."""
    leaf = collision_near()
    x, xd = jnp.array([0.02, 0.02, 0.02]), jnp.array([-0.1, -0.1, 0.0])
    push = jnp.array([-3.0, 3.0, -3.0])
    f, m = leaf.scalar(x, xd)
    pressed, same = leaf.scalar_against(x, xd, push)
    np.testing.assert_array_equal(m, same)
    np.testing.assert_allclose(pressed - f, m * np.array([3.0, 0.0, 3.0]), rtol=1e-5)


def test_joint_limits_add_it_on_the_side_that_contacts_press_to():
    """Each side by itself; RMPflow's leaf, a baseline, takes no notice."""
    leaf = JointLimitBarrier(np.array([-1.0]), np.array([1.0]))
    for q, push in ((0.85, 5.0), (-0.85, -5.0)):
        x, rest = jnp.array([q]), jnp.zeros(1)
        f, m = leaf.scalar(x, rest)
        pressed, same = leaf.scalar_against(x, rest, jnp.array([push]))
        freed, _ = leaf.scalar_against(x, rest, jnp.array([-push]))
        np.testing.assert_array_equal(m, same)
        np.testing.assert_allclose(pressed - f, -m * push, rtol=1e-5)
        np.testing.assert_allclose(freed, f, atol=1e-6 * np.abs(f).max())
    other = RMPflowJointLimit(np.array([-1.0]), np.array([1.0]))
    x, xd = jnp.array([0.9]), jnp.array([0.1])
    np.testing.assert_array_equal(
        other.scalar(x, xd)[0], other.scalar_against(x, xd, jnp.array([9.0]))[0]
    )


def test_contact_acceleration_is_that_of_the_torque_up_to_its_cap(robot):
    """Against NumPy's solve, 1e-4 in float32; beyond the cap the direction stays."""
    response = ContactResponse()
    q = jnp.asarray(robot.q_home, jnp.float32)
    Mq, _ = dynamics(robot, arm_state(robot, q, jnp.zeros(N)))
    tau = np.array([1.0, -2.0, 0.5, 1.0, 0.0, 0.1, 0.05], np.float32)
    w = np.asarray(response.acceleration(Mq, jnp.asarray(tau)))
    expected = np.linalg.solve(np.asarray(Mq, float), tau)
    np.testing.assert_allclose(w, expected, rtol=0, atol=1e-4 * np.abs(expected).max())
    most = np.asarray(response.acceleration(Mq, jnp.asarray(1e4 * tau)))
    np.testing.assert_allclose(np.abs(most).max(), 50.0, rtol=1e-5)
    np.testing.assert_allclose(most / 50.0, w / np.abs(w).max(), atol=1e-4)


def test_attractors_let_go_as_contacts_press():
    """1 while nothing presses, 0.1 halfway, 0.01 from 10 m/s^2 on."""
    weight = ContactResponse().attractor_weight
    for pressed, expected in ((0.0, 1.0), (5.0, 0.1), (10.0, 0.01), (99.0, 0.01)):
        np.testing.assert_allclose(weight(jnp.float32(pressed)), expected, rtol=1e-5)


@pytest.fixture(scope="module")
def answer(robot):
    """The controller beside a sphere, with a contact torque."""

    @jax.jit
    def call(ctrl, q, tau_ext, center):
        setpoint = ctrl.setpoint(q, ctrl.decode(jnp.zeros(12)), 0.0)
        slots = Obstacles.empty(spheres=1).with_spheres(center[None], 0.05)
        return ctrl(q, jnp.zeros(N), setpoint, slots, tau_ext)

    return call


def test_a_pressed_gap_keeps_its_acceleration(answer, robot):
    """Beside a sphere, pressed at it by 20 N: without the response the gap closes, with
    it the acceleration of the gap that results is what it is without contact, or more.
    """
    ctrl = RMPVICES(robot)
    q = jnp.asarray(robot.q_home, jnp.float32)
    arm = arm_state(robot, q, jnp.zeros(N))
    site = site_state(robot, arm)
    Mq, _ = dynamics(robot, arm)
    down = jnp.array([0.0, 0.0, 1.0])
    points = np.array([p for _, p, _ in _world_points(robot, np.asarray(q))])
    low = points[np.argmin(points[:, 2] - _radii(robot))]
    center = jnp.asarray(low - [0.0, 0.0, 0.05 + 0.012 + _radii(robot).min()], "f")
    tau_ext = -20.0 * site.J_pos.T @ down
    w = jnp.linalg.solve(Mq, tau_ext)
    gap = {}
    for name, variant in {
        "blind": ctrl.replace(contact=None),
        "aware": ctrl,
    }.items():
        out = answer(variant, q, tau_ext, center)
        gap[name] = float(down @ (site.J_pos @ (out.qdd + w)))
    assert gap["aware"] > gap["blind"] + 1.0
    held = answer(ctrl, q, tau_ext, center).diagnostics["attractor_weight"]
    assert held < 1.0
    free = answer(ctrl, q, 0.0 * tau_ext, center)
    blind = answer(ctrl.replace(contact=None), q, 0.0 * tau_ext, center)
    np.testing.assert_allclose(free.tau, blind.tau, atol=1e-4)


def _radii(robot):
    return np.array([r for _, _, r in robot.control_points])


def _world_points(robot, q):
    model = robot.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    for body, offset, radius in robot.control_points:
        b = model.body(body).id
        yield body, data.xpos[b] + data.xmat[b].reshape(3, 3) @ offset, radius


@jax.jit
def hand(robot, q):
    """Inertia and Jacobians at the hand."""
    arm = arm_state(robot, q, jnp.zeros_like(q))
    site = site_state(robot, arm)
    return dynamics(robot, arm)[0], site.J_pos, site.J_ori


@jax.jit
def turning(robot, q, w):
    """The turn that a blocking force gives the hand."""
    arm = arm_state(robot, q, jnp.zeros_like(q))
    return turning_by_contact(site_state(robot, arm), dynamics(robot, arm)[0], w)


def test_a_force_at_the_hand_turns_it_as_computed(robot, states):
    """A rigid point contact takes the hand's whole commanded acceleration: the turn is
    that of the constrained dynamics, in NumPy; 1e-7 relative, float64."""
    rng = np.random.default_rng(2)
    for q in states(0)[0][:20]:
        with jax.enable_x64(True):
            M, Jp, Jo = (np.asarray(x) for x in hand(robot, q))
        a = rng.normal(size=3)  # commanded, all of it taken by the contact
        mobility = Jp @ np.linalg.solve(M, Jp.T)
        force = -np.linalg.solve(mobility, a)
        w = np.linalg.solve(M, Jp.T @ force)
        np.testing.assert_allclose(Jp @ w, -a, atol=1e-9)
        # A torque at the hand alone, which no force explains, is not asked back.
        null = np.linalg.solve(M, Jo.T @ rng.normal(size=3))
        null -= np.linalg.solve(M, Jp.T @ np.linalg.solve(mobility, Jp @ null))
        with jax.enable_x64(True):
            turn, rest = (np.asarray(turning(robot, q, x)) for x in (w, null))
        size = np.abs(turn).max()
        np.testing.assert_allclose(turn, Jo @ w, rtol=0, atol=1e-7 * size)
        np.testing.assert_allclose(rest, 0.0, atol=1e-9)


def test_gradients_through_the_response_are_finite(answer, robot):
    """By the contact torque, at zero torque too, in contact and free."""
    q = jnp.asarray(robot.q_home, jnp.float32)

    def loss(tau_ext, center):
        ctrl = RMPVICES(robot)
        setpoint = ctrl.setpoint(q, ctrl.decode(jnp.ones(12)), 0.0)
        slots = Obstacles.empty(spheres=1).with_spheres(center[None], 0.05)
        return jnp.sum(ctrl(q, 0.0 * q, setpoint, slots, tau_ext).tau)

    slope = jax.jit(jax.grad(loss, (0, 1)))
    for size in (0.0, 1.0, 100.0):
        for center in ([0.3, 0.0, 0.1], [0.0, 0.0, -5.0]):
            found = slope(jnp.full(N, size), jnp.array(center))
            assert all(np.isfinite(x).all() for x in jax.tree.leaves(found))
