"""The pullback from the control points to the joints, as a sum over the points."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rmp_mjx.robot.configurations import random_configurations
from rmp_mjx.robot.kinematics import arm_state
from rmp_mjx.robot.point_state import (
    PointRMP,
    point_carrier,
    point_state,
    pull_to_joints,
)
from rmp_mjx.vec import Vec
from tests.oracles import Measured, in_float64


def test_it_is_the_sum_of_what_each_point_asks_for(bent):
    """J' M J and J' (f - M a) with MuJoCo's Jacobians, in 5 states; 1e-11 of some
    thousands: rounding."""
    rng, measured, p = np.random.default_rng(0), Measured(bent), len(bent.points.body)

    def pulled(q, qd, f, M):
        arm = arm_state(bent, q, qd)
        points = point_state(bent, arm)
        rows = [M[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]
        rmp = PointRMP(Vec.of(f, 1), *rows)
        return pull_to_joints(bent, arm, points, rmp), points.a.stack(1)

    run = in_float64(pulled)
    for q in random_configurations(bent, 5):
        half = rng.normal(size=(p, 3, 3))
        f, M = rng.normal(size=(p, 3)), half @ half.swapaxes(1, 2)
        rmp, a = run(q, rng.normal(size=4), f, M)
        data, force, metric = measured.at(q), np.zeros(4), np.zeros((4, 4))
        mujoco.mj_comPos(measured.model, data)
        for k, x in enumerate(measured.points(q)):
            J, body = np.zeros((3, 4)), measured.model.body(bent.points.body[k]).id
            mujoco.mj_jac(measured.model, data, J, None, x, body)
            force += J.T @ (f[k] - M[k] @ a[k])
            metric += J.T @ M[k] @ J
        np.testing.assert_allclose(rmp.f, force, rtol=0, atol=1e-11)
        np.testing.assert_allclose(rmp.M, metric, rtol=0, atol=1e-11)


def test_every_point_is_carried_by_its_link(bent):
    expected = np.eye(4)[:, np.array(bent.points.segment)]
    np.testing.assert_array_equal(point_carrier(bent), expected)
    no_force = Vec.of(jnp.zeros(3), 0)
    rows = PointRMP(no_force, *map(jnp.asarray, range(6))).rows
    found = [[float(x) for x in (row.x, row.y, row.z)] for row in jax.device_get(rows)]
    assert found == [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
