"""The arms of the tasks.

All tasks are made for the Jaco 2, whose base is the origin. Any other arm gets a finger
with the shape of the Jaco's, and stands where it reaches best all that the tasks ask
for; its grip starts where the Jaco's does. So a task looks the same with every arm.
"""

from __future__ import annotations

import functools
import tomllib
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rmp_mjx.robot import Robot, RobotError
from rmp_mjx.robot.inverse import hand_pose

from .scene import ASSETS
from .stands import EXACT, Need, Pose, Stand, lead, search

JACO = "jaco2"
"""The arm that the tasks were made for."""

STORED = ASSETS / "arms.toml"
"""Where the arms that ship stand; from `python -m envs.place_arms`."""


def need(task: Any) -> Need:
    """What a task (a class) asks of an arm."""
    start = _grip(tuple(map(float, task.q_start)))
    return Need(task.Options.env, start, tuple(task.places()))


@functools.cache
def _grip(q: tuple[float, ...]) -> Pose:
    """The grip of the Jaco 2 in a posture."""
    p, R = hand_pose(_jaco(), np.array([q]))
    return Pose(p[0], R[0])


@functools.cache
def _jaco() -> Robot:
    return Robot.load(JACO)


class Fitted(NamedTuple):
    """An arm that is ready for a task."""

    robot: Robot
    """The arm in its place, with its finger."""
    mount: Float[np.ndarray, " 3"]
    """Where its base stands [m]."""
    start: Float[np.ndarray, " n"]
    """Joint coordinates at the start of the task [rad or m]."""


@functools.lru_cache(maxsize=16)
def fit(name: str, task: Any) -> Fitted:
    """Make an arm ready for a task.

    Args:
        name: A name of `rmp_mjx.robots`, or a path; not the Jaco 2.
        task: The task's class.

    Raises:
        RobotError: There is no such arm, or it does not reach what the task asks for.
    """
    asked = need(task)
    if name in stored():
        robot, stand = _standing(name)
    else:
        stand = search(Robot.load(name, finger=0.0), [asked])
        robot = Robot.load(name, mount=stand.mount, finger=stand.turn)
    start, q = asked.start, np.asarray(stand.posture)[None]
    q, miss = lead(robot, q, start.p[None], start.R[None])
    if miss[0] > EXACT:
        raise RobotError(f"'{name}' does not reach the start of task '{asked.task}'")
    return Fitted(robot, stand.mount, np.round(q[0], 6))


@functools.cache
def _standing(name: str) -> tuple[Robot, Stand]:
    """An arm that was placed before."""
    stand = stored()[name]
    return Robot.load(name, mount=stand.mount, finger=stand.turn), stand


@functools.cache
def stored() -> dict[str, Stand]:
    """The arms that were placed before, by name."""
    found = tomllib.loads(STORED.read_text())
    return {
        name: Stand(np.array(arm["mount"]), arm["turn"], np.array(arm["q"]))
        for name, arm in found.items()
    }
