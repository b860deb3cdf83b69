"""Closed-form kinematics against autodiff of the map, and against MuJoCo's points."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rmp_mjx.robot.configurations import joint_frames, random_configurations
from rmp_mjx.robot.kinematics import (
    arm_state,
    base_point,
    carry_points,
    point_positions,
    site_pose,
)
from tests import oracles
from tests.oracles import Measured, along


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


def test_an_arm_with_a_slide_and_a_base_of_its_own_moves_as_mujocos(bent, ours):
    """Site and control points in 50 states; speeds of 3 m/s, 1e-10 of 30 m/s^2."""
    rng, measured = np.random.default_rng(0), Measured(bent)
    q, qd = random_configurations(bent, 50), rng.normal(size=(50, 4))
    terms, twist, (x, v, a) = ours(bent, q, qd)
    expected = oracles.mujoco_terms(bent.mj_model, "tip", q, qd)
    for name, found, theirs in zip(terms._fields, terms, expected, strict=True):
        np.testing.assert_allclose(found, theirs, rtol=0, atol=1e-10, err_msg=name)
    np.testing.assert_allclose(twist, np.einsum("kij,kj->ki", terms.J, qd), atol=1e-11)
    points = [measured.points(q_k) for q_k in q]
    np.testing.assert_allclose(x, points, rtol=0, atol=1e-12)
    with jax.enable_x64(True):
        move = jax.jit(jax.vmap(point_positions, (None, 0)))
        alone = move(bent, q)
        np.testing.assert_allclose(alone, points, rtol=0, atol=1e-12)
    for k in range(5):  # central differences: 1e-4 of 30 m/s^2
        rate, curve, _ = along(lambda q, _: measured.points(q).ravel(), q[k], qd[k])
        np.testing.assert_allclose(v[k].ravel(), rate, rtol=0, atol=1e-6)
        np.testing.assert_allclose(a[k].ravel(), curve, rtol=0, atol=1e-4)


def test_points_of_the_fixed_base_stay_in_the_world(bent):
    """They are given in the world frame; 1e-12 m: one sum is undone."""
    offset = np.random.default_rng(0).normal(size=(4, 3))
    segment = np.array([-1, 3, -1, 0])
    q = random_configurations(bent, 1)[0]
    with jax.enable_x64(True):
        arm = jax.jit(arm_state)(bent, q, jnp.zeros(4))
        x, carrier = carry_points(bent, arm, offset, segment)
        world = x.stack(1) + base_point(bent)[None]
    p, R = joint_frames(bent, q[None])
    for i, k in enumerate(segment):
        expected = offset[i] if k < 0 else p[k, 0] + R[k, 0] @ offset[i]
        np.testing.assert_allclose(world[i], expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(carrier, np.eye(4)[:, [0, 3, 0, 0]] * (segment >= 0))
