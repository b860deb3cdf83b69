"""What a task hands over: state, score, entries of the observation, measures."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

from flax import struct
from jaxtyping import Array, Bool, Float, Int

from rmp_mjx.control.observer import ContactMemory
from rmp_mjx.metric import SUCCESS, Metric, of_fields
from rmp_mjx.pytree import Pytree
from rmp_mjx.sim import PhysicsState

from . import safety
from .randomisation import Motors


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
    Entry("position", 3, "m", "grip site in the task's frame"),
    Entry("rotation", 9, "-", "its rotation matrix, row by row"),
    Entry("velocity", 3, "m/s", "its velocity"),
    Entry("angular_velocity", 3, "rad/s", "its angular velocity"),
)
"""What every observation begins with."""


class ControlMemory(Pytree):
    """What the controller is told of the control steps before this one."""

    contact: ContactMemory | None
    """Memory of the observer of contact torque; None without one."""
    tau: Float[Array, " n"] | None
    """Torque of the last control step [N m]; None for an arm without a limit on its
    rate."""
    motors: Motors | None = None
    """What becomes of the commanded torques; None if they act as they are."""

    def acting(self, tau: Float[Array, " n"]) -> Float[Array, " n"]:
        """The torque that acts after this control step [N m].

        Args:
            tau: What the controller commands, (n,) [N m].
        """
        return tau if self.motors is None else self.motors.torque


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


def measured(metric: Metric) -> Any:
    """A field of `Measures`: the metric that it is."""
    return struct.field(metadata={"metric": metric})


class Measures(Pytree):
    """Measures of one policy step; each field declares its metric."""

    success: Bool[Array, ""] = measured(SUCCESS)
    """Whether the task is solved in this step."""
    contact_impulse: Float[Array, ""] = measured(
        Metric("contact_impulse", "sum", unit="N s")
    )
    """Impulse of the collisions' normal forces [N s]."""
    clearance: Float[Array, ""] = measured(
        Metric("clearance", "min", unit="m", table=("mean", "min"))
    )
    """Least distance of a control point to the table, a fixture or a sphere, at the
    end of the step [m]."""
    tracking_error: Float[Array, ""] = measured(
        Metric("tracking_error", "mean", unit="m", table=("mean",))
    )
    """Distance of the grip to its set-point at the end of the step [m]."""
    unplaced_obstacles: Int[Array, ""] = measured(
        Metric("unplaced_obstacles", "max", fault="some spheres found no place")
    )
    """Spheres of this episode that found no place."""
    nonfinite: Bool[Array, ""] = measured(Metric("nonfinite", "max"))
    """Whether the state is not finite or absurdly fast."""

    @property
    def values(self) -> dict[str, Array]:
        """Every field by name."""
        fields = dataclasses.fields(self)
        return {field.name: getattr(self, field.name) for field in fields}


METRICS = {SUCCESS.name: SUCCESS} | safety.METRICS | of_fields(Measures)
"""Metrics of every task by name; a table shows them in this order."""
