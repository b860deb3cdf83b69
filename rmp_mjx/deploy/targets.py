"""Where a loop's set-points come from: the policy, or a pose to go to."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from rmp_mjx.deploy.deployed import Deployed
from rmp_mjx.deploy.sources import Seen


class Targets(Protocol):
    """Gives the set-point of a policy step."""

    def __call__(
        self, q: np.ndarray, qd: np.ndarray, time: float, seen: Seen
    ) -> dict[str, Any]:
        """The set-point.

        Args:
            q: Joint positions, (n,) [rad].
            qd: Joint velocities, (n,) [rad/s].
            time: Since the start of the loop [s].
            seen: The obstacles.
        """
        ...


class Task(Protocol):
    """What a policy is told of its task: `ViaPoints`, `Objects`, or your own."""

    def told(self, p: np.ndarray, time: float) -> dict[str, Any]:
        """The arrays that the file's `observe` takes, by name.

        Args:
            p: Position of the grip, (3,) [m].
            time: Since the start of the loop [s].
        """
        ...


class ViaPoints:
    """The task of trajectory following: which points there are, which are reached."""

    def __init__(self, points: np.ndarray, reach: float = 0.05):
        """Begin with none reached.

        Args:
            points: Via points in their order, (4, 3) in the task's frame [m].
            reach: A point counts as reached within this distance of the grip [m].
        """
        self.points = np.asarray(points, np.float32)
        self.reach = reach
        self.reached = 0
        self.times: list[float] = []
        self.nearest = np.full(len(self.points), np.inf)

    @property
    def done(self) -> bool:
        """Whether all are reached."""
        return self.reached == len(self.points)

    def told(self, p: np.ndarray, time: float) -> dict[str, Any]:
        """What the policy is told when the grip is at p (3,) [m] at this time [s]."""
        if not self.done:
            distance = float(np.linalg.norm(self.points[self.reached] - p))
            self.nearest[self.reached] = min(self.nearest[self.reached], distance)
            if distance < self.reach:
                self.reached += 1
                self.times.append(time)
        return {"points": self.points, "reached": np.int32(self.reached)}


class PolicyTargets:
    """The policy of an exported file that has an `observe`."""

    def __init__(self, deployed: Deployed, task: Task):
        """Compile it.

        Args:
            deployed: The file.
            task: What the policy is told.

        Raises:
            ValueError: The file has no `observe`.
        """
        self.task = task
        self._grip, self._plan = deployed.flat("grip"), deployed.flat_plan()

    def __call__(
        self, q: np.ndarray, qd: np.ndarray, time: float, seen: Seen
    ) -> dict[str, Any]:
        """The set-point that the policy wants."""
        self._grip.put(0, q)
        self._grip.put(1, qd)
        told = self.task.told(self._grip()["p"], time)
        for place, value in enumerate((q, qd, told, seen.slots, np.float32(time))):
            self._plan.put(place, value)
        return self._plan()


class ReachTargets:
    """Go to a pose of the grip, and stay."""

    STEP, TURN = 0.05, 0.2
    """How far ahead of the grip the set-point is at most [m, rad], as a policy's."""

    def __init__(
        self, deployed: Deployed, q_goal: np.ndarray, stiffness: float = 100.0
    ):
        """Compile it.

        Args:
            deployed: The file.
            q_goal: Joint positions whose grip pose is the goal, (n,) [rad].
            stiffness: Of position and orientation [1/s^2].
        """
        self._grip = deployed.flat("grip")
        self._example = deployed.examples("control")[2]
        self.goal = self._pose(q_goal)
        self.stiffness = stiffness
        self.distance = np.inf

    def _pose(self, q: np.ndarray) -> dict[str, np.ndarray]:
        self._grip.put(0, q)
        self._grip.put(1, np.zeros_like(q))
        return {name: x.copy() for name, x in self._grip().items()}

    def __call__(
        self, q: np.ndarray, qd: np.ndarray, time: float, seen: Seen
    ) -> dict[str, Any]:
        """A set-point on the way; `distance` says how far the goal is [m]."""
        now = self._pose(q)
        way = self.goal["p"] - now["p"]
        self.distance = float(np.linalg.norm(way))
        way *= min(1.0, self.STEP / max(self.distance, 1e-9))
        turn = _angle_axis(self.goal["R"] @ now["R"].T)
        angle = float(np.linalg.norm(turn))
        turn *= min(1.0, self.TURN / max(angle, 1e-9))
        stiff = np.full(3, self.stiffness, np.float32)
        found = {
            "p_des": now["p"] + way,
            "R_des": _rotation(turn) @ now["R"],
            "kp_pos": stiff,
            "kp_ori": stiff,
            "time": np.float32(0.0),  # stands still: no dither at rest
        }
        if "weights" in self._example:
            one, zero = np.float32(1.0), np.float32(0.0)
            found["weights"] = {"attractor": one, "posture": one, "standoff": zero}
        return found


def _angle_axis(R: np.ndarray) -> np.ndarray:
    """Axis times angle of a rotation, (3,) [rad]; of a half turn, no turn."""
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = 0.5 * np.linalg.norm(axis), 0.5 * (np.trace(R) - 1.0)
    return axis * (np.arctan2(sine, cosine) / max(2.0 * sine, 1e-9))


def _rotation(turn: np.ndarray) -> np.ndarray:
    """The rotation of axis times angle, (3, 3)."""
    angle = np.linalg.norm(turn)
    x, y, z = turn / max(angle, 1e-9)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * (K @ K)
