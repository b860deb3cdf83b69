"""Gradients are finite where they are hard: at rest, in contact, at singularities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx import Obstacles
from rmp_mjx.robot.kinematics import arm_state, base_point, site_pose
from rmp_mjx.robot.point_state import point_state
from rmp_mjx.types import Setpoint
from tests.control.conftest import QUICK

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

    return jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3, 4)), compiler_options=QUICK)


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
    return x.stack(-1) + base_point(robot)
