"""The motion of the set-point that frees a hand which stands."""

import jax
import jax.numpy as jnp
import numpy as np

from rmp_mjx import Obstacles, Stirring

STILL = np.zeros(3, np.float32)


def test_it_grows_as_the_room_shrinks_and_stays_within_its_amplitude():
    """1e-7 m: float32. No room lost, no stirring, whatever the time."""
    stir = Stirring(amplitude=0.03, near=0.02, far=0.05)
    times = jnp.linspace(0.0, 100.0, 1000)
    at = jax.vmap(lambda time, room: stir(time, room, STILL), (0, None))
    for room, share in ((jnp.inf, 0.0), (0.05, 0.0), (0.035, 0.5), (0.0, 1.0)):
        moved = np.abs(at(times, jnp.asarray(room))).max(0)
        assert np.all(moved <= 0.03 * share + 1e-7)
        assert np.all(moved >= 0.029 * share - 1e-7)


def test_the_first_axis_goes_round_in_its_period():
    stir = Stirring(period=2.5)
    whole, half = (stir(t, jnp.zeros(()), STILL) for t in (2.5, 1.25 / 2))
    np.testing.assert_allclose(whole[0], 0.0, atol=1e-7)
    np.testing.assert_allclose(half[0], stir.amplitude, rtol=1e-6)


def test_a_hand_that_moves_is_left_alone():
    """At three times the speed that counts as standing exp(-9) = 1.2e-4 is left."""
    stir, room = Stirring(), jnp.zeros(())
    moving = stir(0.6, room, jnp.array([3.0 * stir.speed, 0.0, 0.0]))
    np.testing.assert_allclose(moving, np.exp(-9.0) * stir(0.6, room, STILL), rtol=1e-4)


def test_at_time_zero_the_set_point_stays_where_it_is(run64, ctrl, states, obstacles):
    """So it does for a controller that is never told it; 1e-9: float64."""
    q, qd, action = states(5)
    near = obstacles(5)
    ours, plain = (
        run64(c, q, qd, action, near).tau for c in (ctrl, ctrl.replace(stirring=None))
    )
    np.testing.assert_allclose(ours, plain, rtol=1e-9, atol=1e-9)


def test_time_moves_the_torque_beside_a_body_alone(ctrl):
    """A sphere 1 cm off the fingers, and the same 20 cm further off."""
    q = jnp.asarray(ctrl.robot.q_home, jnp.float32)
    grip = ctrl.setpoint(q, ctrl.decode(jnp.zeros(12))).p_des

    @jax.jit
    def torque(time, away):
        center = grip + jnp.array([0.022 + 0.01 + 0.05 + away, 0.0, 0.0])
        ball = Obstacles.empty(spheres=1).with_spheres(center[None], 0.05)
        target = ctrl.setpoint(q, ctrl.decode(jnp.zeros(12)))
        return ctrl(q, jnp.zeros(7), target.replace(time=time), ball).tau

    now, later = jnp.float32(0.0), jnp.float32(0.6)
    assert np.abs(torque(now, 0.0) - torque(later, 0.0)).max() > 0.1
    np.testing.assert_array_equal(torque(now, 0.2), torque(later, 0.2))
