"""A task of your own, from outside of the repository: follow a point on a circle.

    cd docs/examples
    rmp-mjx-train --env own_task:Circle --radius 0.08
    rmp-mjx-eval --env own_task:Circle --run runs/NAME

`docs/add_a_task.md` explains what a task defines.
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from rmp_mjx_envs import ArmEnv, Entry, Options, Score

MIDDLE = np.array([0.45, 0.0, 0.20])  # m


@dataclasses.dataclass(frozen=True)
class CircleOptions(Options):
    """Options of following."""

    env: ClassVar[str] = "circle"
    episode_length: int = 200
    """Policy steps until the time limit."""
    radius: float = 0.1
    """Radius of the circle [m]."""
    period: float = 5.0
    """Time of a round [s]."""


class Circle(ArmEnv[CircleOptions]):
    """Keep the hand within 2 cm of a point that goes round."""

    Options = CircleOptions
    q_start = np.array([3.192, 3.680, 0.0, 1.170, 0.050, 3.760, 3.142])
    sphere_box = (MIDDLE - 0.2, MIDDLE + 0.2)

    @property
    def task_entries(self):
        """The way to the point, and where it is on its circle."""
        return (
            Entry("way", 3, "m", "the point from the hand"),
            Entry("phase", 2, "", "cosine and sine of its angle"),
        )

    def begin(self, rng, q):
        """Anywhere on the circle."""
        return jnp.zeros(0), {"angle": jax.random.uniform(rng, maxval=2 * np.pi)}

    def point(self, task):
        """Where the point is, (3,) [m]."""
        angle = task["angle"]
        way = jnp.stack([jnp.zeros(()), jnp.cos(angle), jnp.sin(angle)])
        return MIDDLE + self.options.radius * way

    def score(self, data, site, record, task, step):
        """The nearer, the better; the point moves on."""
        away = jnp.linalg.norm(self.point(task) - site.p)
        turn = 2 * np.pi * self.dt / self.options.period
        task = {"angle": task["angle"] + turn}
        return Score(task, 1.0 - jnp.tanh(10.0 * away), away < 0.02, {})

    def observe(self, data, site, task):
        """Entries of the observation."""
        angle = task["angle"]
        phase = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        return {"way": self.point(task) - site.p, "phase": phase}

    def keep_clear(self, task):
        """No sphere on the circle's middle."""
        return MIDDLE[None]
