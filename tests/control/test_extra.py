"""Leaves of a user join the tree of RMP-VICES."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx import RMPVICES, Node, Obstacles, Robot, ScalarLeaf, TaskMap
from rmp_mjx.rmp import evaluate
from rmp_mjx.robot.kinematics import site_pose

ROBOT = Robot.load("planar3", spacing=0.2)


def height(q):
    """Height of the end effector, (1,) [m]."""
    return site_pose(ROBOT, q)[0][2:]


class Wind(ScalarLeaf):
    """A constant acceleration of 1 m/s^2."""

    weight: float = 0.5

    def scalar(self, x, xd):
        m = jnp.full_like(x, self.weight)
        return m, m


BRANCHES = (Node(TaskMap(height), (Wind(),)), Wind(weight=0.1))


@pytest.fixture(scope="module")
def outputs():
    """Without and with extra branches, each without contact and in one."""
    q, qd = jnp.asarray(ROBOT.q_home, jnp.float32), jnp.array([0.1, -0.2, 0.3])
    calm = RMPVICES(ROBOT)
    setpoint = calm.setpoint(q, calm.decode(jnp.zeros(12)), 0.0)
    push = jnp.array([[0.0, 0.0, 0.0], [0.0, 30.0, 0.0]])

    @jax.jit
    def run():
        def both(tau_ext):
            windy = calm.replace(extra=BRANCHES)
            return [
                c(q, qd, setpoint, Obstacles.empty(), tau_ext) for c in (calm, windy)
            ]

        return jax.vmap(both)(push)

    plain, windy = run()
    assert calm.contact is not None
    w = [calm.contact.acceleration(plain.Mq[0], tau) for tau in push]
    return q, qd, w, plain, windy


@pytest.mark.parametrize("k", [0, 1], ids=["free", "in contact"])
def test_the_root_is_the_sum_of_the_tree_and_the_extra_branches(outputs, k):
    """In contact they ask for their acceleration on top of what it takes.

    Rounding of float32 sums of numbers up to 100: 1e-4.
    """
    q, qd, w, calm, windy = outputs
    for name in ("f", "M"):
        own = sum(getattr(evaluate(b, q, qd, w[k]), name) for b in BRANCHES)
        added = (getattr(windy, name) - getattr(calm, name))[k]
        np.testing.assert_allclose(added, own, atol=1e-4)


def test_contacts_reach_the_extra_branches(outputs):
    _, _, _, calm, windy = outputs
    own = windy.f - calm.f
    assert np.abs(own[1] - own[0]).max() > 0.5


def test_the_parameters_of_extra_branches_are_leaves_of_the_controller():
    ctrl = RMPVICES(ROBOT, extra=(Wind(weight=0.25),))
    assert 0.25 in [x for x in jax.tree.leaves(ctrl) if isinstance(x, float)]
