"""A leaf of your own in the controller: the hand stays above a floor that you invent.

    python docs/examples/own_leaf.py

The set-point is below the floor, and there is no obstacle: the leaf holds the hand.
`docs/add_a_leaf.md` explains leaves.
"""

import jax
import jax.numpy as jnp
import numpy as np

import rmp_mjx as rmp
from rmp_mjx.robot.kinematics import site_pose

FLOOR = 0.55  # m


class Floor(rmp.ScalarLeaf):
    """A spring and damper that count the more, the lower the coordinate is."""

    height: float = FLOOR
    """Coordinate of the floor [m]."""

    def scalar(self, x, xd):
        """Force and metric, shaped like x."""
        above = x - self.height
        m = 1000.0 * jax.nn.sigmoid(-above / 0.01)
        return m * (-200.0 * above - 30.0 * xd), m


def lowest(extra: tuple, seconds: float) -> float:
    """Least height of the hand while its target lies 30 cm below it [m]."""
    robot = rmp.Robot.load("planar3")
    ctrl = rmp.RMPVICES(robot, extra=extra)
    q = jnp.asarray(robot.q_home, jnp.float32)
    action = rmp.Action(
        jnp.array([0.0, 0.0, -0.3]), jnp.zeros(3), jnp.full(3, 50.0), jnp.zeros(3)
    )
    setpoint = ctrl.setpoint(q, action, 0.0)

    def step(state, _):  # the accelerations, without physics
        q, qd = state
        out = ctrl(q, qd, setpoint, rmp.Obstacles.empty())
        qd = qd + 0.005 * out.qdd
        q = q + 0.005 * qd
        return (q, qd), site_pose(robot, q)[0][2]

    steps = round(seconds / 0.005)
    heights = jax.lax.scan(step, (q, 0.0 * q), None, length=steps)[1]
    return float(jnp.min(heights))


def main(seconds: float = 3.0) -> tuple[float, float]:
    """The hand's least height without the leaf, and with it [m]."""
    robot = rmp.Robot.load("planar3")

    def height(q):
        return site_pose(robot, q)[0][2:]

    leaf = rmp.Node(rmp.TaskMap(height), (Floor(),))
    return lowest((), seconds), lowest((leaf,), seconds)


if __name__ == "__main__":
    without, with_leaf = np.round(main(), 3)
    print(f"lowest: {without} m without the leaf, {with_leaf} m with it, floor {FLOOR}")
