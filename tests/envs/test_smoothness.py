"""Changes and reversals of torques, jerks of joints."""

import jax.numpy as jnp
import numpy as np

from envs.smoothness import Motion, Torques


def test_smoothness_is_read_from_consecutive_torques():
    tau = np.array([[0, 0], [3, 0], [1, 0], [1.5, 0], [1.2, 5]], float)
    torques, jumps, reversals = Torques.start(2), [], []
    for row in tau:
        torques = torques.then(jnp.asarray(row))
        jumps.append(float(jnp.max(jnp.abs(torques.change))))
        reversals.append(bool(torques.reversed))
    np.testing.assert_allclose(jumps, [0, 3, 2, 0.5, 5])
    # 3 up, 2 down; 0.5 is too little
    assert reversals == [False, False, True, False, False]


def test_jerk_is_the_second_difference_of_the_velocities():
    """Of qd = t^2 and t^3 / 6: 2 and about t, at 5 ms from the second step on."""
    dt, t = 0.005, 0.005 * np.arange(8)
    motion, jerks = Motion.start(jnp.zeros(2)), []
    for row in np.stack([t**2, t**3 / 6], axis=1)[1:]:
        motion = motion.then(jnp.asarray(row, jnp.float32), dt)
        jerks.append(np.asarray(motion.jerk))
    np.testing.assert_array_equal(jerks[0], 0.0)  # there is no step before
    # A velocity of 1e-3 in float32 is good to 1e-10, divided by dt^2.
    np.testing.assert_allclose(np.stack(jerks[1:])[:, 0], 2.0, atol=1e-4)
    np.testing.assert_allclose(np.stack(jerks[1:])[:, 1], t[1:-1], atol=1e-4)
