"""The paper's own numbers.

Source: Shaw et al., "RMPs for Safe Impedance Control in Contact-Rich Manipulation"
(2021), the captions of the training figure and the deployment table.
"""

from __future__ import annotations

from typing import NamedTuple

EPISODES = 100
"""Episodes of each entry of the deployment table."""

TRAINING_DROP = {
    "collision": {"trajectory": None, "door": 39.8, "push": 54.6},
    "joint_limit": {"trajectory": 90.5, "door": 90.7, "push": 93.2},
}
"""Events in training: how much lower the area under RMP-VICES' curve is than under
VICES' [%]; None: not applicable."""


class Deployed(NamedTuple):
    """An entry of the deployment table."""

    mean: float
    """Mean return."""
    sd: float
    """Its standard deviation."""
    collision: int
    """Episodes of 100 that a collision ended."""
    joint_limit: int
    """Episodes of 100 that a joint limit ended."""


DEPLOYMENT = {
    "vices": {
        "trajectory": Deployed(7864.0, 11670.0, 56, 44),
        "door": Deployed(1703.0, 1948.0, 61, 36),
        "push": Deployed(1755.0, 2256.0, 93, 0),
    },
    "rmp_vices": {
        "trajectory": Deployed(6847.0, 3723.0, 25, 22),
        "door": Deployed(1051.0, 696.0, 5, 11),
        "push": Deployed(1740.0, 854.0, 19, 0),
    },
}
"""Deployed among two unseen spheres."""
