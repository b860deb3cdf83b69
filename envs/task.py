"""What a task says: its scene, its start, its score, its observation, its pictures."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import ClassVar, Generic, Literal, NamedTuple, TypeVar

import mujoco
import numpy as np
from jaxtyping import Array, Float

from rmp_mjx.metric import Metric
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.robot import Robot
from rmp_mjx.robot.kinematics import SiteState
from rmp_mjx.sim import PhysicsState

from . import sight
from .options import Options as TaskOptions
from .safety import SafetyRecord
from .scene import Contacts, no_objects
from .stands import Place
from .types import ARM_ENTRIES, Entry, Score, State

Color = tuple[float, float, float, float]
"""Red, green, blue and opacity, each 0 to 1."""

REACHED: Color = (0.15, 0.65, 0.3, 0.55)
CURRENT: Color = (0.1, 0.45, 0.95, 0.95)
LATER: Color = (0.1, 0.45, 0.95, 0.35)
GOAL: Color = (0.15, 0.65, 0.3, 0.6)


class View(NamedTuple):
    """A camera."""

    lookat: tuple[float, float, float] = (0.25, 0.0, 0.2)
    """Point in the middle of the picture [m]."""
    distance: float = 1.4
    """Distance of the camera from it [m]."""
    azimuth: float = 143.0
    """Direction of view in the horizontal plane [degrees]."""
    elevation: float = -22.0
    """Direction of view against the horizontal plane [degrees]."""


FRONT = View()
"""The usual view: from beyond the workspace, at the arm's right."""


class Mark(NamedTuple):
    """Something that the policy must reach."""

    shape: Literal["ball", "disc"]
    """A ball, or a thin upright cylinder."""
    place: Float[np.ndarray, " 3"]
    """Its centre [m]."""
    radius: float
    """Its radius [m]."""
    color: Color
    """Its colour."""


OptionsT = TypeVar("OptionsT", bound=TaskOptions)


class Task(abc.ABC, Generic[OptionsT]):
    """The part of an environment that differs from task to task."""

    Options: ClassVar[type[TaskOptions]] = TaskOptions
    """The task's options."""
    q_start: ClassVar[np.ndarray]
    """Start configuration of the Jaco 2, (7,) [rad]. The grip of any other arm starts
    at the same pose."""
    sphere_box: ClassVar[tuple[np.ndarray, np.ndarray]]
    """Corners of the box for the spheres' centres [m]."""
    task_metrics: ClassVar[tuple[Metric, ...]] = ()
    """The task's own metrics; `score` gives their values."""
    fixture_slots: ClassVar[dict[str, int]] = {}
    """Obstacle slots that `fixtures` fills, by kind, besides the table's plane."""
    view: ClassVar[View] = FRONT
    """Where pictures are taken from."""

    options: OptionsT
    """The options' values."""
    robot: Robot
    """The arm."""

    @property
    def name(self) -> str:
        """The task's name."""
        return self.options.env

    @classmethod
    def places(cls) -> Sequence[Place]:
        """Where an arm's grip must be able to get from the start; arms stand for it."""
        return ()

    @property
    @abc.abstractmethod
    def task_entries(self) -> tuple[Entry, ...]:
        """The task's part of the observation."""

    @abc.abstractmethod
    def begin(
        self, rng: Array, q: Float[Array, " n"]
    ) -> tuple[Array, dict[str, Array]]:
        """Start an episode.

        Args:
            rng: Randomness.
            q: The arm's start configuration [rad].

        Returns:
            Positions of the objects' joints, and the task's part of `State.info`.
        """

    @abc.abstractmethod
    def score(
        self,
        data: PhysicsState,
        site: SiteState,
        record: SafetyRecord,
        task: dict[str, Array],
        step: Array,
    ) -> Score:
        """Judge a policy step.

        Args:
            data: Physics after the step.
            site: Pose and velocity of the grip then.
            record: Contacts, forces and events during the step.
            task: The task's part of `State.info` before it.
            step: Policy steps of this episode, this one included.
        """

    @abc.abstractmethod
    def observe(
        self, data: PhysicsState, site: SiteState, task: dict[str, Array]
    ) -> dict[str, Array]:
        """The task's part of the observation, an array for each of `task_entries`."""

    @abc.abstractmethod
    def keep_clear(self, task: dict[str, Array]) -> Float[Array, "v 3"]:
        """Points that the spheres' layout keeps clear [m]."""

    def objects(self, spec: mujoco.MjSpec) -> Contacts:
        """Add the task's objects to the scene."""
        return no_objects(spec)

    def fixtures(self, slots: Obstacles, data: PhysicsState) -> Obstacles:
        """Fill in the fixtures that the controller avoids besides the table."""
        del data
        return slots

    def marks(self, state: State) -> Sequence[Mark]:
        """What pictures mark in this state, for instance a goal."""
        del state
        return ()

    @property
    def entries(self) -> tuple[Entry, ...]:
        """The observation, entry by entry."""
        seen = sight.entries(self.options.seen_spheres)
        return ARM_ENTRIES + self.task_entries + seen

    @property
    def observation_size(self) -> int:
        """Numbers in an observation."""
        return sum(entry.size for entry in self.entries)
