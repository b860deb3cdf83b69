"""Where an arm stands in the tasks: a search for where it reaches all they ask for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rmp_mjx.robot import Robot, RobotError
from rmp_mjx.robot.configurations import (
    capsule_ends,
    capsule_gaps,
    joint_frames,
    random_configurations,
)
from rmp_mjx.robot.inverse import hand_pose, reach
from rmp_mjx.robot.posture import manipulability

from .scene import TABLE_HEIGHT

TURN = np.pi / 4
"""Turns of the grip about the finger are multiples of this [rad]."""

NEAR, FAR = -0.6, 0.2
"""Between these the base stands, ahead of the Jaco 2's, on the line y = 0 [m]."""

HIGHEST = 0.4
"""It stands on the table, or up to so much above [m]."""

SEEDS, KEPT = 150, 8
"""Postures that are tried for each place of the base, and led to everything."""

WAY = 8
"""Parts of a straight way."""

LIMIT = 0.1
"""So near to the end of its range a joint makes an event [rad or m]."""

ROOM, GAP, ABILITY = 0.25, 0.05, 0.5
"""What is comfortable: room of a joint besides `LIMIT` [rad or m]; distance of the arm
from itself, the table, and what stands on it [m]; manipulability as a share of its
median."""

EXACT = 1e-3
"""What inverse kinematics may miss [m plus rad]."""


class Pose(NamedTuple):
    """Where the grip has to be."""

    p: Float[np.ndarray, " 3"]
    """Position [m]."""
    R: Float[np.ndarray, "3 3"]
    """Orientation."""


class Box(NamedTuple):
    """What the arm has to keep off."""

    center: Float[np.ndarray, " 3"]
    """Its centre [m]."""
    half: Float[np.ndarray, " 3"]
    """Half of its edges [m]."""
    R: Float[np.ndarray, "3 3"]
    """Its orientation."""


class Place(NamedTuple):
    """A point that the grip must reach from the start of a task without turning."""

    p: Float[np.ndarray, " 3"]
    """Where it is [m]."""
    box: Box | None = None
    """What stands in the way there."""


class Need(NamedTuple):
    """What a task asks of an arm."""

    task: str
    """Its name."""
    start: Pose
    """Where the grip starts."""
    places: tuple[Place, ...]
    """Where it has to get from there."""


class Stand(NamedTuple):
    """How an arm is set up for the tasks."""

    mount: Float[np.ndarray, " 3"]
    """Where its base stands [m]."""
    turn: float
    """Angle of the grip about the finger [rad]."""
    posture: Float[np.ndarray, " n"]
    """Joint coordinates from which it goes to the start of any task [rad or m]."""
    score: float = np.inf
    """The worst there is on all ways: 1 is comfortable, 0 useless."""


def search(robot: Robot, needs: Sequence[Need]) -> Stand:
    """Where an arm reaches best all that tasks ask for.

    For many places of the base, postures are searched that have the grip at the start
    of the first task. From there it is led straight to everything else, as a policy
    may lead it. The score is the least of these on all ways, each as a share of what is
    comfortable: room to the ends of the joints' ranges, manipulability, and the arm's
    distance from itself, the table, and what stands in the way. Of comfortable postures
    the one nearest to the arm's `q_home` is best. The random numbers are always the
    same.

    Args:
        robot: The arm, with its finger, its base at the origin.
        needs: What the tasks ask for.

    Raises:
        RobotError: It has fewer than six joints, or nowhere reaches all.
    """
    if robot.n < 6:
        raise RobotError(
            f"'{robot.name}' cannot do the tasks: they need 6 degrees of freedom, it "
            f"has {robot.n}"
        )
    judge = _Judge(robot, needs)
    x = np.linspace(NEAR, FAR, 9)
    z = TABLE_HEIGHT + np.linspace(0.0, HIGHEST, 5)
    best = judge.best(x, z)
    for fine in (0.05, 0.025):
        near = np.array([-fine, 0.0, fine])
        z = np.clip(best.mount[2] + near, TABLE_HEIGHT, TABLE_HEIGHT + HIGHEST)
        best = max(best, judge.best(best.mount[0] + near, z), key=judge.value)
    if not best.score > 0.0:
        raise RobotError(f"'{robot.name}' does not fit the tasks: {judge.fault(best)}")
    return best


def lead(
    robot: Robot,
    q: Float[np.ndarray, "s n"],
    p: Float[np.ndarray, "s 3"],
    R: Float[np.ndarray, "s 3 3"],
    note: Callable[[np.ndarray, np.ndarray, bool], None] = lambda *_: None,
) -> tuple[Float[np.ndarray, "s n"], Float[np.ndarray, " s"]]:
    """Lead grips straight to poses, in small steps.

    Args:
        robot: The arm.
        q: Where they begin, (s, n) [rad or m]; redundant arms prefer this.
        p: Positions, (s, 3) [m].
        R: Orientations, (s, 3, 3).
        note: Called at every part of the way with the joint coordinates, what they
            miss, and whether it is the end.

    Returns:
        Joint coordinates at the end, and what they miss, in metres plus radians.
    """
    rest, begin, miss = q, hand_pose(robot, q)[0], np.zeros(len(q))
    for k in range(1, WAY + 1):
        aim = begin + (p - begin) * (k / WAY)
        q, miss = reach(robot, q, aim, R, steps=4 if k < WAY else 12, rest=rest)
        note(q, miss, k == WAY)
    return q, miss


class _Judge:
    """Compares stands of one arm."""

    def __init__(self, robot: Robot, needs: Sequence[Need]):
        """Remember what is asked for."""
        self.robot, self.needs = robot, needs
        self.home = np.asarray(robot.q_home)
        postures = random_configurations(robot, 2000)
        self.median = float(np.median(manipulability(robot, postures)))

    def value(self, stand: Stand) -> float:
        """What is greatest at the best stand."""
        away = np.sqrt(np.mean(np.square(stand.posture - self.home)))
        return min(stand.score, 1.0) - 0.05 * float(away)

    def best(self, x: np.ndarray, z: np.ndarray) -> Stand:
        """The best stand with the base at a height of z and so far ahead as x."""
        robot, rng = self.robot, np.random.default_rng(0)
        a, b = (grid.ravel() for grid in np.meshgrid(x, np.unique(z)))
        mounts = np.stack([a, 0.0 * a, b], axis=1)
        mount = np.repeat(mounts, SEEDS, axis=0)
        turn = TURN * rng.integers(0, 8, len(mount))
        q = self.home + rng.normal(0.0, 0.3, (len(mount), robot.n))
        far = random_configurations(robot, len(mount)).clip(-np.pi, np.pi)
        q = np.where((np.arange(len(mount)) % 2 == 0)[:, None], q, far)
        q = np.clip(q, robot.q_lower, robot.q_upper)
        start = self.needs[0].start
        R = start.R @ _about_z(-turn)
        q, miss = reach(robot, q, start.p - mount, R, steps=60)
        score = self.score(q, mount) - _penalty(miss)
        order = np.argsort(-score.reshape(-1, SEEDS), axis=1)[:, :KEPT]
        chosen = (order + SEEDS * np.arange(len(order))[:, None]).ravel()
        q, mount, turn = np.round(q[chosen], 4), mount[chosen], turn[chosen]
        score = np.minimum.reduce(
            [self.worst(q, mount, turn, need, place) for need, place in self.ways()]
        )
        mount = np.round(mount, 4)
        stands = [
            Stand(*each)
            for each in zip(mount, turn.tolist(), q, score.tolist(), strict=True)
        ]
        return max(stands, key=self.value)

    def ways(self) -> list[tuple[Need, Place]]:
        """All that is asked for; the start of a task is its own first place."""
        return [
            (need, place)
            for need in self.needs
            for place in (Place(need.start.p), *need.places)
        ]

    def worst(
        self,
        q: Float[np.ndarray, "s n"],
        mount: Float[np.ndarray, "s 3"],
        turn: Float[np.ndarray, " s"],
        need: Need,
        place: Place,
    ) -> Float[np.ndarray, " s"]:
        """The least score on the ways to a task's start and on to a place of it."""
        R, worst = need.start.R @ _about_z(-turn), np.full(len(q), np.inf)

        def note(q: np.ndarray, miss: np.ndarray, end: bool) -> None:
            nonlocal worst
            score = self.score(q, mount, place.box if end else None)
            worst = np.minimum(worst, score - _penalty(miss))

        q, miss = lead(self.robot, q, need.start.p - mount, R)
        worst = -_penalty(miss) + np.where(miss > EXACT, 0.0, np.inf)
        lead(self.robot, q, place.p - mount, R, note)
        return worst

    def score(
        self,
        q: Float[np.ndarray, "s n"],
        mount: Float[np.ndarray, "s 3"],
        box: Box | None = None,
    ) -> Float[np.ndarray, " s"]:
        """The least of room, manipulability and distances, (s,)."""
        robot, capsules = self.robot, self.robot.capsules
        room = np.minimum(q - robot.q_lower, robot.q_upper - q).min(axis=1) - LIMIT
        found = [room / ROOM, manipulability(robot, q) / (ABILITY * self.median)]
        # The last link works near the table.
        links = [c for c, k in enumerate(capsules.segment) if 1 <= k < robot.n - 1]
        for c, (start, end) in capsule_ends(robot, q, links).items():
            low = np.minimum(start[:, 2], end[:, 2]) - capsules.radius[c]
            found.append((low + mount[:, 2] - TABLE_HEIGHT) / GAP)
        if capsules.pairs:
            found.append(capsule_gaps(robot, q, capsules.pairs).min(axis=1) / GAP)
        if box is not None:
            found.append(_distance(robot, q, mount, box) / GAP)
        return np.minimum.reduce(found)

    def fault(self, stand: Stand) -> str:
        """What is wrong with a stand."""
        q, mount, turn = (
            np.asarray(x)[None] for x in (stand.posture, stand.mount, stand.turn)
        )
        scores = [self.worst(q, mount, turn, *way)[0] for way in self.ways()]
        need, place = self.ways()[int(np.argmin(scores))]
        R = need.start.R @ _about_z(-turn)
        q, _ = lead(self.robot, q, need.start.p - mount, R)
        q, miss = lead(self.robot, q, place.p - mount, R)
        short = np.linalg.norm(hand_pose(self.robot, q)[0] + mount - place.p)
        x, y, z = place.p
        goal = f"({x:.2f}, {y:.2f}, {z:.2f}) m of task '{need.task}'"
        if short > EXACT:
            return f"wherever it stands, it misses {goal} by {100 * short:.0f} cm"
        if miss[0] > EXACT:
            return f"wherever it stands, it cannot point the finger down at {goal}"
        return (
            f"wherever it stands, on its way to {goal} a joint is at its end, or the "
            "arm touches something"
        )


def _penalty(miss: np.ndarray) -> np.ndarray:
    """What is taken off the score for a pose that is missed."""
    return 10.0 * np.where(miss > EXACT, miss + 0.5, 0.0)


def _distance(
    robot: Robot, q: np.ndarray, mount: np.ndarray, box: Box
) -> Float[np.ndarray, " s"]:
    """Distance of the arm's control points from a box, (s,) [m]."""
    p, R = joint_frames(robot, q)
    points, segment = robot.points, np.array(robot.points.segment)
    x = p[segment] + np.einsum("psij,pj->psi", R[segment], points.offset)
    x = (x + mount - box.center) @ box.R
    gap = np.linalg.norm(np.maximum(np.abs(x) - box.half, 0.0), axis=-1)
    return (gap - np.asarray(points.radius)[:, None]).min(axis=0)


def _about_z(angle: Float[np.ndarray, " s"]) -> Float[np.ndarray, "s 3 3"]:
    """Rotations about z by angles [rad]."""
    c, s, zero = np.cos(angle), np.sin(angle), 0.0 * angle
    rows = [c, -s, zero, s, c, zero, zero, zero, zero + 1.0]
    return np.stack(rows, axis=-1).reshape(-1, 3, 3)
