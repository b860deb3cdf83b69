"""What a task hands over: state, score, entries of the observation."""

from __future__ import annotations

from typing import Any, NamedTuple

from jaxtyping import Array, Float

from rmp_mjx.pytree import Pytree
from rmp_mjx.sim import PhysicsState


class Entry(NamedTuple):
    """One group of numbers of an observation."""

    name: str
    """Name."""
    size: int
    """How many numbers."""
    unit: str
    """Unit; `-` if none."""
    meaning: str
    """What they say."""


ARM_ENTRIES = (
    Entry("position", 3, "m", "grip site in the arm's base frame"),
    Entry("rotation", 9, "-", "its rotation matrix, row by row"),
    Entry("velocity", 3, "m/s", "its velocity"),
    Entry("angular_velocity", 3, "rad/s", "its angular velocity"),
)
"""What every observation begins with."""


class State(Pytree):
    """State of one environment (the Brax and Playground convention)."""

    data: PhysicsState
    """Physics."""
    obs: Float[Array, " n"]
    """Observation."""
    reward: Float[Array, ""]
    """Reward of the last step."""
    done: Float[Array, ""]
    """1 if the episode ended, by the task or by a safety event."""
    metrics: dict[str, Array]
    """Scalars of the last step; the keys never change."""
    info: dict[str, Any]
    """What an episode carries along; `info["task"]` is the task's own. The keys never
    change."""

    @property
    def task(self) -> dict[str, Array]:
        """The task's part of `info`."""
        return self.info["task"]


class Score(NamedTuple):
    """A task's verdict on one policy step."""

    task: dict[str, Array]
    """The task's part of `State.info` after the step."""
    reward: Array
    """Reward, events not counted."""
    success: Array
    """Whether the task is solved in this step."""
    metrics: dict[str, Array]
    """Values of the task's own metrics (`Task.task_metrics`), by name."""
