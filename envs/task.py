"""What a task says: its scene, its start, its score, its observation, its pictures."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import ClassVar, Generic, TypeVar

import mujoco
import numpy as np
from jaxtyping import Array, Float

from envs.options import Options as TaskOptions
from envs.safety import SafetyRecord
from envs.scene import Contacts, no_objects
from envs.types import ARM_ENTRIES, Entry, Score, State
from envs.views import FRONT, Mark, View
from rmp_mjx.metric import Metric
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.rmp import ScalarLeaf
from rmp_mjx.robot import Robot
from rmp_mjx.robot.kinematics import SiteState
from rmp_mjx.sim import PhysicsState

OptionsT = TypeVar("OptionsT", bound=TaskOptions)


class Task(abc.ABC, Generic[OptionsT]):
    """The part of an environment that differs from task to task."""

    Options: ClassVar[type[TaskOptions]] = TaskOptions
    """The task's options."""
    q_start: ClassVar[np.ndarray]
    """Start configuration of the Jaco 2, (7,) [rad]."""
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

    def collision_leaves(self, robot: Robot) -> dict[str, ScalarLeaf]:
        """Collision leaves by kind of obstacle, where the default does not fit."""
        del robot
        return {}

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
        return ARM_ENTRIES + self.task_entries

    @property
    def observation_size(self) -> int:
        """Numbers in an observation."""
        return sum(entry.size for entry in self.entries)
