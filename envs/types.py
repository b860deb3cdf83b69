"""What a task hands over: state, score, observation entries, metrics."""

from __future__ import annotations

from typing import Any, NamedTuple

from jaxtyping import Array, Float

from rmp_mjx.pytree import Pytree
from rmp_mjx.sim import PhysicsState

METRICS = {
    "success": "max",
    "collision": "sum",
    "arm_collision": "sum",
    "obstacle_collision": "sum",
    "self_collision": "sum",
    "joint_limit": "sum",
    "turn_limit": "sum",
    "contact_force": "mean",
    "contact_force_peak": "max",
    "contact_impulse": "sum",
    "work_force": "mean",
    "work_force_peak": "max",
    "clearance": "min",
    "torque_saturation": "mean",
    "torque_jump": "max",
    "torque_reversals": "mean",
    "joint_jerk": "max",
    "tracking_error": "mean",
    "unplaced_obstacles": "max",
    "contact_overflow": "max",
    "nonfinite": "max",
}
"""Metrics of every task and how a step's value folds into the episode's.

Events (`sum`) count when they begin. Forces are normal forces of collisions [N], their
impulse is in N s; `work_force` is the hand's on what it works with. `clearance` is the
least distance of a control point to the table, a fixture or a sphere [m], at the end of
each policy step. `torque_jump` is the largest change of a torque between two physics
steps of a policy step [N m], `torque_reversals` the share of physics steps in which a
torque turns round: what an oscillation does. `joint_jerk` is the largest change of a
joint's acceleration between two of them, over the timestep [rad/s^3].
"""


SHARED = ("rng", "step", "spheres", "going_on")
"""Keys of `State.info` that every task has; the others are the task's own."""


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
    """What the task carries along; the keys never change."""


class Score(NamedTuple):
    """A task's verdict on one policy step."""

    task: dict[str, Array]
    """The task's part of `State.info`, brought up to date."""
    reward: Array
    """Reward, events not counted."""
    success: Array
    """Whether the task is solved in this step."""
    metrics: dict[str, Array]
    """The task's own metrics."""
