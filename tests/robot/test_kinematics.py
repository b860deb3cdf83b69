"""Closed-form kinematics against autodiff of the map, and against MuJoCo's points."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rmp_mjx.robot.kinematics import point_positions, site_pose


@pytest.fixture(scope="module")
def ours_at(ours, robot, states):
    return ours(robot, *states)


def test_site_velocity_is_the_jacobian_times_qd(ours_at, states):
    terms, twist, _ = ours_at
    expected = np.einsum("kij,kj->ki", terms.J, states[1])
    # 1e-12 of about 10 rad/s.
    np.testing.assert_allclose(twist, expected, rtol=0.0, atol=1e-11)


def test_jacobian_and_curvature_are_the_derivatives_of_the_pose(robot, states, ours_at):
    """Forward-mode autodiff of `site_pose`, once and twice."""

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(None, 0, 0))
    def derivatives(robot, q, qd):
        def position(q):
            return site_pose(robot, q)[0]

        def velocity(q):
            return jax.jvp(position, (q,), (qd,))[1]

        return jax.jacfwd(position)(q), jax.jvp(velocity, (q,), (qd,))[1]

    with jax.enable_x64(True):
        J, Jdot_qd = jax.device_get(derivatives(robot, *states))
    terms = ours_at[0]
    # Rounding of a chain of seven products, lengths of 1 m, speeds of 10 rad/s.
    np.testing.assert_allclose(terms.J[:, :3], J, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(terms.Jdot_qd[:, :3], Jdot_qd, rtol=0.0, atol=1e-10)


def test_control_points_move_as_mujoco_moves_their_bodies(robot, states, ours_at):
    """Position, velocity and curvature of every point, from mj_jac and mj_jacDot."""
    model = robot.mj_model
    data = mujoco.MjData(model)
    _, _, (x, v, a) = ours_at
    for k in range(20):
        data.qpos[:], data.qvel[:] = states[0][k], states[1][k]
        mujoco.mj_forward(model, data)
        for i, (body, offset, _) in enumerate(robot.control_points):
            b = model.body(body).id
            point = data.xpos[b] + data.xmat[b].reshape(3, 3) @ offset
            J, Jdot = np.zeros((3, 7)), np.zeros((3, 7))
            mujoco.mj_jac(model, data, J, None, point, b)
            mujoco.mj_jacDot(model, data, Jdot, None, point, b)
            np.testing.assert_allclose(x[k, i], point, rtol=0.0, atol=1e-12)
            np.testing.assert_allclose(v[k, i], J @ data.qvel, rtol=0.0, atol=1e-11)
            np.testing.assert_allclose(a[k, i], Jdot @ data.qvel, rtol=0.0, atol=1e-10)


def test_points_are_where_their_motion_says(robot, states, ours_at):
    """`point_positions` of 5 states: 1e-12 m, rounding of another sum."""
    _, _, (x, _, _) = ours_at
    with jax.enable_x64(True):
        for k in range(5):
            alone = point_positions(robot, jnp.asarray(states[0][k]))
            np.testing.assert_allclose(alone, x[k], rtol=0.0, atol=1e-12)


def test_pose_keeps_the_precision_it_is_called_in(robot):
    for x64, dtype in ((False, jnp.float32), (True, jnp.float64)):
        with jax.enable_x64(x64):
            p, R = jax.eval_shape(
                lambda q: site_pose(robot, q), jax.ShapeDtypeStruct((7,), dtype)
            )
        assert p.dtype == R.dtype == dtype
