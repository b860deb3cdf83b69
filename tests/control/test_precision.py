"""Float32 against float64, and a hundred thousand hard states in float32."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx import Obstacles
from rmp_mjx.robot.kinematics import arm_state, base_point, site_pose
from rmp_mjx.robot.point_state import point_state
from rmp_mjx.types import Setpoint


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


def test_torque_is_finite_and_within_limits_in_20_000_hard_states(
    run32, ctrl, robot, states, obstacles
):
    """Overlapping obstacles, joints far beyond their limits, broken actions."""
    rng = np.random.default_rng(0)
    scenes = [obstacles(seed, scale=0.15, speed=3.0) for seed in range(4)]
    broken = np.array([np.nan, np.inf, -np.inf, 1e30])
    overlapping = 0
    for k in range(40):
        q, qd, action = states(100 + k, reach=5.0, speed=4.0)
        bad = rng.random(action.shape) < 0.05
        action = np.where(bad, rng.choice(broken, action.shape), action)
        out = run32(ctrl, q, qd, action, scenes[k % 4])
        assert np.isfinite(out.tau).all() and np.isfinite(out.qdd).all()
        assert np.all(np.abs(out.tau) <= np.float32(robot.tau_max))
        at_limit = np.abs(out.tau) == np.float32(robot.tau_max)
        assert np.array_equal(out.diagnostics["torque_limit"] != 0.0, at_limit)
        overlapping += np.sum(out.diagnostics["clearance"] < 0.0)
    assert overlapping > 2_000


STRAIGHT = np.array([0.0, np.pi, 0.0, np.pi, 0.0, np.pi, 0.0])
"""The Jaco pointing straight up: elbow and wrist singular at once."""


@pytest.fixture(scope="module")
def gradient():
    """Gradients of torque and acceleration by q, qd, set-point, scene and leaves."""

    def loss(parts, q, qd, setpoint, centers, active, ctrl):
        slots = Obstacles.empty(spheres=2).with_spheres(centers, 0.1)
        slots = slots.replace(spheres=slots.spheres.replace(active=active))
        out = ctrl.replace(**parts)(q, qd, setpoint, slots)
        return jnp.sum(out.tau) + jnp.sum(out.qdd) + jnp.sum(out.M)

    return jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3, 4)))


def _parts(ctrl):
    """Everything tunable of the controller."""
    names = ("leaves", "obstacle_relaxation", "limit_relaxation", "dither")
    parts = {name: getattr(ctrl, name) for name in names}
    parts |= {"attractor_weight": 1.0, "regularizer": 1e-3}
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), parts)


CASES = {
    "at rest on target": ("home", 0.0, False, 0.0),
    "moving freely": ("home", 1.0, False, 0.1),
    "straight up at rest": ("straight", 0.0, False, 0.0),
    "straight up, moving": ("straight", 1.0, True, 0.1),
    "points at two spheres' centres, moving": ("home", 1.0, True, 0.1),
    "points at two spheres' centres at rest": ("home", 0.0, True, 0.0),
    "far beyond the joint limits": ("beyond", 1.0, True, 0.1),
    "turned by half a turn": ("home", 0.0, False, np.pi),
}


@pytest.mark.parametrize(
    ("pose", "speed", "touching", "turn"), CASES.values(), ids=CASES.keys()
)
def test_every_gradient_is_finite(robot, ctrl, gradient, pose, speed, touching, turn):
    q = {
        "home": robot.q_home,
        "straight": STRAIGHT,
        "beyond": np.full(7, 9.0),
    }[pose].astype("f")
    qd = np.full(7, speed, "f")
    p, R = (np.asarray(x) for x in _pose(robot, q))
    c, s = np.cos(turn), np.sin(turn)
    R_des = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], "f") @ R
    setpoint = Setpoint(p, R_des, np.full(3, 100.0, "f"), np.full(3, 50.0, "f"), 0.6)
    centers = np.asarray(_points(robot, q))[[20, 50]]
    found = gradient(_parts(ctrl), q, qd, setpoint, centers, np.full(2, touching), ctrl)
    for path, leaf in jax.tree_util.tree_leaves_with_path(found):
        assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)


@jax.jit
def _pose(robot, q):
    return site_pose(robot, q)


@jax.jit
def _points(robot, q):
    """World positions of the control points, in the arithmetic of the controller."""
    x = point_state(robot, arm_state(robot, q, jnp.zeros_like(q))).x
    return x.stack(-1) + base_point(robot)[None]
