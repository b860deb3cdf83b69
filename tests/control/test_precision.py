"""Float32 against float64, and a hundred thousand hard states in float32."""

import jax
import numpy as np


def _rounded(tree):
    """Inputs that both precisions hold exactly."""
    return jax.tree.map(
        lambda x: x.astype("f").astype(x.dtype) if x.dtype == np.float64 else x, tree
    )


def test_float32_is_close_to_float64_with_obstacles_near(
    run32, run64, ctrl, robot, states, obstacles
):
    """2,000 states, control points inside obstacles or up to 20 cm away.

    The metrics are capped at 1e3 and the root is regularised by the inertia, so the
    error stays at float32's rounding times the root's condition. Measured, as a share
    of the torque limits: median 2e-6, 90 % 8e-4, 99 % 1e-2, largest 9e-2; the
    acceleration's largest relative error is 0.11. Between machines
    the tails move by a factor of three.
    """
    worst, errors, clearances = 0.0, [], []
    for seed in range(4):
        args = _rounded((*states(10 + seed), obstacles(10 + seed)))
        single, double = run32(ctrl, *args), run64(ctrl, *args)
        error = np.abs(single.tau - double.tau) / robot.tau_max
        errors.append(error.max(axis=1))
        clearances.append(double.diagnostics["clearance"])
        difference = np.abs(single.qdd - double.qdd).max(1)
        worst = max(worst, np.max(difference / (1.0 + np.abs(double.qdd).max(1))))
    errors, clearances = np.concatenate(errors), np.concatenate(clearances)
    assert np.quantile(errors, 0.5) < 5e-5
    assert np.quantile(errors, 0.99) < 1.5e-2
    assert errors.max() < 0.1
    assert worst < 0.3
    assert np.mean(clearances < 0.05) > 0.5


def test_torque_is_finite_and_within_limits_in_100_000_hard_states(
    run32, ctrl, robot, states, obstacles
):
    """Overlapping obstacles, joints far beyond their limits, broken actions."""
    rng = np.random.default_rng(0)
    scenes = [obstacles(seed, scale=0.15, speed=3.0) for seed in range(4)]
    broken = np.array([np.nan, np.inf, -np.inf, 1e30])
    overlapping = 0
    for k in range(200):
        q, qd, action = states(100 + k, reach=5.0, speed=4.0)
        bad = rng.random(action.shape) < 0.05
        action = np.where(bad, rng.choice(broken, action.shape), action)
        out = run32(ctrl, q, qd, action, scenes[k % 4])
        assert np.isfinite(out.tau).all() and np.isfinite(out.qdd).all()
        assert np.all(np.abs(out.tau) <= np.float32(robot.tau_max))
        scale = out.diagnostics["torque_scale"]
        assert np.all((scale >= 0.0) & (scale <= 1.0))
        overlapping += np.sum(out.diagnostics["clearance"] < 0.0)
    assert overlapping > 10_000
