"""The orientation attractor's weight beside obstacles."""

import jax.numpy as jnp
import numpy as np

from rmp_mjx import OrientationRelaxation

UP = np.array([0.0, 0.0, 1.0])


def test_weight_falls_from_one_to_its_least_as_the_clearance_shrinks():
    """Geometrically; 1e-6: float32."""
    weight = OrientationRelaxation(min_weight=0.01, near=0.02, far=0.08)
    clearance = jnp.asarray([jnp.inf, 1.0, 0.08, 0.05, 0.02, -0.1])
    np.testing.assert_allclose(
        weight(clearance), [1.0, 1.0, 1.0, 0.1, 0.01, 0.01], rtol=1e-6
    )


def test_orientation_is_relaxed_beside_bodies_but_not_beside_planes(
    run64, ctrl, states, obstacles
):
    """Clearance to spheres, capsules and boxes counts, whatever the floor does."""
    q, qd, action = states(3)
    near = obstacles(3)
    low = near.planes.replace(point=near.planes.point - 5.0 * UP)
    high = near.planes.replace(point=near.planes.point + 0.4 * UP)
    weights = []
    leaf = OrientationRelaxation(min_weight=0.01, near=0.02, far=0.08)
    holding = ctrl.replace(obstacle_relaxation=leaf, limit_relaxation=None)
    for planes in (low, high):
        out = run64(holding, q, qd, action, near.replace(planes=planes))
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
