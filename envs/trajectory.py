"""Trajectory following: visit four via points in order (VICES' free-space path)."""

from __future__ import annotations

import dataclasses
import itertools
from typing import ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rmp_mjx.metric import Metric
from rmp_mjx.robot.kinematics import SiteState
from rmp_mjx.sim import PhysicsState

from . import options
from .base import ArmEnv
from .placement import sample_apart
from .safety import SafetyRecord
from .stands import Place
from .task import CURRENT, LATER, REACHED, Mark
from .types import Entry, Score, State

BOX_LOW = np.array([0.30, -0.20, 0.03])
BOX_HIGH = np.array([0.55, 0.20, 0.28])
"""Corners of the via points' box [m]."""


@dataclasses.dataclass(frozen=True)
class TrajectoryOptions(options.Options):
    """Options of trajectory following."""

    env: ClassVar[str] = "trajectory"
    terminate_on_success: bool = True
    """Whether the last via point ends the episode."""
    observation: Literal["rotated", "fixed"] = "rotated"
    """rotated: vectors to the via points, the current one first; fixed: the paper's
    list of positions and checked flags."""


class Trajectory(ArmEnv[TrajectoryOptions]):
    """Reach four random via points, one after the other.

    Reward: 100 on reaching the current point (within 5 cm), else 30 (1 - tanh(5 d));
    on finishing 25 per step left of the episode; an event costs `event_penalty`.
    """

    Options = TrajectoryOptions
    q_start = np.array([3.192, 3.680, 0.0, 1.170, 0.050, 3.760, 3.142])
    sphere_box = (BOX_LOW, BOX_HIGH)
    task_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("via_points", "sum", headline="via", table=("mean",)),
    )
    n_points = 4
    reach = 0.05
    """A via point counts as reached within this distance [m]."""

    @classmethod
    def places(cls) -> list[Place]:
        """The corners of the via points' box."""
        corners = itertools.product(*zip(BOX_LOW, BOX_HIGH, strict=True))
        return [Place(np.array(corner)) for corner in corners]

    @property
    def task_entries(self) -> tuple[Entry, ...]:
        """Via points and flags."""
        n, rotated = self.n_points, self.options.observation == "rotated"
        points = (
            "via points from the grip, the current one first"
            if rotated
            else "via points in the task's frame, in their order"
        )
        return (
            Entry("points", 3 * n, "m", points),
            Entry("reached", n, "-", "1 for each of them that is reached"),
        )

    def begin(
        self, rng: Array, q: Float[Array, " n"]
    ) -> tuple[Array, dict[str, Array]]:
        """Draw via points at least 10 cm apart."""
        points, _ = sample_apart(rng, self.n_points, BOX_LOW, BOX_HIGH, 0.10)
        return jnp.zeros(0), {"points": points, "reached": jnp.zeros((), jnp.int32)}

    def keep_clear(self, task: dict[str, Array]) -> Float[Array, "v 3"]:
        """The via points."""
        return task["points"]

    def score(
        self,
        data: PhysicsState,
        site: SiteState,
        record: SafetyRecord,
        task: dict[str, Array],
        step: Array,
    ) -> Score:
        """Reward the way to the current via point, reaching it, and finishing."""
        points, reached = task["points"], task["reached"]
        distance = jnp.linalg.norm(
            points[jnp.minimum(reached, self.n_points - 1)] - site.p
        )
        unfinished = reached < self.n_points
        hit = unfinished & (distance < self.reach)
        reached = reached + hit
        finished = hit & (reached == self.n_points)
        shaped = jnp.where(unfinished, 30.0 * (1.0 - jnp.tanh(5.0 * distance)), 0.0)
        reward = jnp.where(hit, 100.0, shaped)
        reward += jnp.where(finished, 25.0 * (self.episode_length - step), 0.0)
        task = {"points": points, "reached": reached}
        return Score(task, reward, finished, {"via_points": hit})

    def observe(
        self, data: PhysicsState | None, site: SiteState, task: dict[str, Array]
    ) -> dict[str, Array]:
        """Via points and which are reached."""
        points, reached = task["points"], task["reached"]
        checked = (jnp.arange(self.n_points) < reached).astype(jnp.float32)
        if self.options.observation == "rotated":
            order = (jnp.arange(self.n_points) + reached) % self.n_points
            points, checked = points[order] - site.p, checked[order]
        return {"points": points, "reached": checked}

    def marks(self, state: State) -> list[Mark]:
        """Balls at the via points: reached, current, later."""
        reached = int(state.task["reached"])
        return [
            Mark(
                "ball",
                np.asarray(point, float),
                0.018,
                REACHED if k < reached else CURRENT if k == reached else LATER,
            )
            for k, point in enumerate(state.task["points"])
        ]
