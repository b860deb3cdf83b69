"""The motion of the set-point that frees a hand at rest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx import RMPVICES, Obstacles, OrientationRelaxation, Robot, SetpointDither
from rmp_mjx.control.relaxation import joint_limit_relaxation
from tests.control.conftest import changed
from tests.robot.test_model import GRIPPER

STILL = jnp.zeros(3)


def test_it_grows_as_the_room_shrinks_and_stays_within_its_amplitude():
    """1e-7 m: float32. No room lost, no dither, whatever the time."""
    dither = SetpointDither(amplitude=0.03, near=0.02, far=0.05)
    times = jnp.linspace(0.0, 100.0, 1000)
    at = jax.vmap(lambda time, room: dither(time, room, STILL), (0, None))
    for room, share in ((jnp.inf, 0.0), (0.05, 0.0), (0.035, 0.5), (0.0, 1.0)):
        moved = np.abs(at(times, jnp.asarray(room))).max(0)
        assert np.all(moved <= 0.03 * share + 1e-7)
        assert np.all(moved >= 0.029 * share - 1e-7)


def test_the_first_axis_goes_round_in_its_period():
    dither = SetpointDither(period=2.5)
    whole, half = (dither(t, jnp.zeros(()), STILL) for t in (2.5, 1.25 / 2))
    np.testing.assert_allclose(whole[0], 0.0, atol=1e-7)
    np.testing.assert_allclose(half[0], dither.amplitude, rtol=1e-6)


def test_a_hand_that_moves_is_left_alone():
    """At three times `speed`, exp(-9) = 1.2e-4 is left."""
    dither, room = SetpointDither(), jnp.zeros(())
    moving = dither(0.6, room, jnp.array([3.0 * dither.speed, 0.0, 0.0]))
    still = dither(0.6, room, STILL)
    np.testing.assert_allclose(moving, np.exp(-9.0) * still, rtol=1e-4)


def test_the_displacement_is_its_documented_formula():
    """Default numbers; 1e-6 of 3 cm: float32 phases."""
    dither, rng = jax.jit(SetpointDither()), np.random.default_rng(0)
    for time, room in rng.uniform([0.0, 0.0], [3.0, 0.06], (40, 2)):
        v = rng.normal(scale=0.04, size=3)
        share = np.clip((0.05 - room) / 0.03, 0.0, 1.0) * np.exp(-(v @ v) / 0.1**2)
        phase = 2 * np.pi * time / 2.5 * np.array([1.0, 0.618, 0.382])
        found = dither(time, jnp.float32(room), jnp.asarray(v, jnp.float32))
        np.testing.assert_allclose(found, 0.03 * share * np.sin(phase), atol=1e-6)


def test_at_time_zero_the_set_point_stays_where_it_is(run64, ctrl, states, obstacles):
    """1e-9: float64."""
    q, qd, action = states(5)
    near = obstacles(5)
    ours, plain = (
        run64(c, q, qd, action, near).tau for c in (ctrl, ctrl.replace(dither=None))
    )
    np.testing.assert_allclose(ours, plain, rtol=1e-9, atol=1e-9)


def test_a_plain_loop_dithers_beside_a_body_and_nowhere_else():
    """Policy steps of 0.1 s with decode, setpoint and call, and nothing else.

    The arm stands still with a sphere 1 cm off its hand, then 20 cm further off.
    """
    ctrl = RMPVICES(Robot.from_mjcf(GRIPPER, site="tip", spacing=0.1))
    ctrl = ctrl.replace(leaves=ctrl.leaves.replace(self_collision=None))
    q, qd = jnp.array([0.1, 0.5, -0.3]), jnp.zeros(3)
    policy = jnp.zeros(12)

    def clearance(center):
        slots = Obstacles.empty(spheres=1).with_spheres(center[None], 0.05)
        setpoint = ctrl.setpoint(q, ctrl.decode(policy), 0.0)
        return ctrl(q, qd, setpoint, slots).diagnostics["clearance"]

    @jax.jit
    def loop(away):
        grip = ctrl.setpoint(q, ctrl.decode(policy), 0.0).p_des
        center = grip + jnp.array([0.1, 0.0, 0.0])
        center -= jnp.array([1.0, 0.0, 0.0]) * (clearance(center) - 0.01 - away)
        slots = Obstacles.empty(spheres=1).with_spheres(center[None], 0.05)

        def policy_step(_, k):
            setpoint = ctrl.setpoint(q, ctrl.decode(policy), 0.1 * k)
            out = ctrl(q, qd, setpoint, slots)
            return None, (out.tau, out.diagnostics["clearance"])

        return jax.lax.scan(policy_step, None, jnp.arange(5))[1]

    tau, room = loop(0.0)
    assert room[0] < 0.04
    assert np.abs(np.diff(tau, axis=0)).max(1).min() > 1e-3
    tau, room = loop(0.2)
    assert room[0] > 0.05
    np.testing.assert_array_equal(np.diff(tau, axis=0), 0.0)


UP = np.array([0.0, 0.0, 1.0])


def test_weight_falls_from_one_to_its_least_as_the_clearance_shrinks():
    """Geometrically; 1e-6: float32."""
    weight = OrientationRelaxation(min_weight=0.01, near=0.02, far=0.08)
    clearance = jnp.asarray([jnp.inf, 1.0, 0.08, 0.05, 0.02, -0.1])
    np.testing.assert_allclose(
        jax.vmap(weight)(clearance), [1.0, 1.0, 1.0, 0.1, 0.01, 0.01], rtol=1e-6
    )


@pytest.mark.parametrize(
    ("weight", "near", "far"),
    [(OrientationRelaxation(), 0.015, 0.07), (joint_limit_relaxation(), 0.2, 1.2)],
    ids=["obstacle", "joint limit"],
)
def test_by_default_a_thousandth_is_left_where_the_room_is_least(weight, near, far):
    rooms = jnp.asarray([0.9 * near, near, 0.5 * (near + far), far, 1.1 * far])
    expected = [1e-3, 1e-3, 10**-1.5, 1.0, 1.0]
    np.testing.assert_allclose(jax.vmap(weight)(rooms), expected, rtol=1e-5)


def test_orientation_is_relaxed_beside_bodies_but_not_beside_planes(
    run64, ctrl, states, obstacles
):
    """Clearance to spheres, capsules and boxes counts, whatever the floor does."""
    q, qd, action = states(3)
    near = obstacles(3)
    low = changed(near.planes, point=near.planes.point - 5.0 * UP)
    high = changed(near.planes, point=near.planes.point + 0.4 * UP)
    weights = []
    leaf = OrientationRelaxation(min_weight=0.01, near=0.02, far=0.08)
    holding = ctrl.replace(obstacle_relaxation=leaf, limit_relaxation=None)
    for planes in (low, high):
        out = run64(holding, q, qd, action, changed(near, planes=planes))
        weights.append(out.diagnostics["orientation_weight"])
        clearance = out.diagnostics["clearance"]
        if planes is low:  # then the nearest obstacle is a body
            share = np.clip((0.08 - clearance) / 0.06, 0.0, 1.0)
            np.testing.assert_allclose(weights[-1], 0.01**share, rtol=1e-9)
    np.testing.assert_array_equal(*weights)
    assert np.mean(weights[0] == 1.0) > 0.05
    assert np.mean(weights[0] < 0.5) > 0.05


def test_orientation_is_relaxed_near_the_nearest_joint_limit(
    run64, ctrl, states, obstacles
):
    """1e-9: float64. Joints without a limit do not count."""
    q, qd, action = states(4)
    # Some of the states are further from their limits.
    leaf = OrientationRelaxation(min_weight=0.01, near=0.2, far=1.0)
    holding = ctrl.replace(obstacle_relaxation=None, limit_relaxation=leaf)
    out = run64(holding, q, qd, action, obstacles(4))
    weight = out.diagnostics["orientation_weight"]
    lower, upper = np.asarray(ctrl.robot.q_lower), np.asarray(ctrl.robot.q_upper)
    assert np.isinf(lower).any()
    room = np.minimum(q - lower, upper - q).min(1)
    share = np.clip((1.0 - room) / 0.8, 0.0, 1.0)
    np.testing.assert_allclose(weight, 0.01**share, rtol=1e-9)
    assert np.mean(weight == 1.0) > 0.05
    assert np.mean(weight < 0.5) > 0.05
