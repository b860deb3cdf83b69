"""The arm's kinematics and dynamics in one compiled function, in float64."""

import jax
import numpy as np
import pytest

from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state, base_point, site_state
from rmp_mjx.robot.point_state import point_state
from tests.oracles import Terms


@pytest.fixture(scope="session")
def ours():
    """`ours(robot, q, qd)`: our terms and the points' motion for k states, float64.

    One compilation per robot.
    """

    @jax.jit
    @lambda f: jax.vmap(f, in_axes=(None, 0, 0))
    def at(robot, q, qd):
        arm = arm_state(robot, q, qd)
        return (
            site_state(robot, arm),
            dynamics(robot, arm),
            point_state(robot, arm),
            base_point(robot),
        )

    def run(robot, q, qd):
        with jax.enable_x64(True):
            site, (Mq, bias), points, base = jax.device_get(at(robot, q, qd))
        J = np.concatenate([site.J_pos, site.J_ori], axis=1)
        Jdot_qd = np.concatenate([site.Jdot_qd_pos, site.Jdot_qd_ori], axis=1)
        x, v, a = (
            np.stack([c.x, c.y, c.z], axis=-1) for c in (points.x, points.v, points.a)
        )
        terms = Terms(site.p, site.R, J, Jdot_qd, Mq, bias)
        twist = np.concatenate([site.v, site.w], axis=1)
        return terms, twist, (x + base[:, None], v, a)

    return run


@pytest.fixture(scope="session")
def states():
    """1,200 states of the Jaco 2: any angle, speeds up to about 6 rad/s."""
    rng = np.random.default_rng(0)
    q = rng.uniform(-np.pi, np.pi, (1200, 7)) + np.pi
    return q, rng.normal(scale=2.0, size=(1200, 7))
