"""The nominal posture: given, from the file, or searched."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rmp_mjx.robot.configurations import (
    capsule_gaps,
    joint_frames,
    random_configurations,
)
from rmp_mjx.robot.errors import Numbers, RobotError, vector

CLOSE = 0.1
"""Share of half a joint's range, from its end: no place for the reference pose."""

SINGULAR = 0.02
"""Nor where it has less than this share of the median manipulability."""

_ROUNDING = 1e-5
"""Allowed overshoot: MuJoCo writes ranges with six digits."""


def nominal_posture(
    joints: Sequence[str],
    lower: np.ndarray,
    upper: np.ndarray,
    home: dict[str, float] | None,
    given: Numbers | None,
) -> np.ndarray | None:
    """The posture that the arm prefers and tasks start at, as far as it is known.

    The first of these that there is: the one given, keyframe `home`.

    Args:
        joints: Names of the joints.
        lower: Lower limits, (n,) [rad or m]; -inf for none.
        upper: Upper limits, (n,).
        home: Keyframe `home` by joint, if the file has it.
        given: Posture that replaces the file's, (n,).

    Returns:
        The posture, (n,), or None.

    Raises:
        RobotError: The posture given or the keyframe is not within the ranges.
    """
    if given is not None:
        q = vector("q_home", given, len(joints))
        _check("q_home", joints, q, lower, upper)
        return q
    if home is not None:
        q = np.array([home[name] for name in joints])
        _check("keyframe 'home'", joints, q, lower, upper)
        return q
    return None


def search_posture(robot: Any, samples: int = 4000) -> tuple[np.ndarray, str]:
    r"""The reference pose if an arm can work from it, else the best random posture.

    The best one has the greatest product of its manipulability
    $\sqrt{\det J J^T}$ (Yoshikawa, 1985), its least room to a joint's end, as a share
    of half the range, and its distance from itself, up to 10 cm. Among equals it is
    near the reference pose.

    Args:
        robot: A `Robot`; its `q_home` does not count.
        samples: Random postures that are compared (fixed seed).

    Returns:
        The posture, (n,), and what is wrong with the reference pose, or nothing.
    """
    q = np.vstack([robot.q_ref[None], random_configurations(robot, samples)])
    reach = manipulability(robot, q)
    room = _room(robot, q)
    gap = np.ones(len(q))
    if robot.capsules.pairs:
        gap = capsule_gaps(robot, q, robot.capsules.pairs).min(axis=1).clip(0.0, 0.1)
    fault = ""
    if room[0] < CLOSE:
        fault = "is outside or near the end of a joint's range"
    elif reach[0] < SINGULAR * np.median(reach):
        fault = "is singular"
    elif gap[0] <= 0.0:
        fault = "is in collision with itself"
    if not fault:
        return q[0], fault
    moved = np.square((q - q[0]) / np.pi).sum(axis=1)
    score = np.maximum(reach, 1e-12) * room.clip(0.0) * gap * np.exp(-moved / 4.0)
    return q[int(np.argmax(score))], fault


def manipulability(robot: Any, q: np.ndarray) -> np.ndarray:
    """Yoshikawa's measure of the end effector's Jacobian in s postures, (s,)."""
    p, R = joint_frames(robot, q)
    hand = p[-1] + R[-1] @ robot.site_offset
    z, hinge = R[..., 2], np.array(robot.hinge)[:, None, None]
    linear = np.where(hinge, np.cross(z, hand - p), z)
    J = np.concatenate([linear, np.where(hinge, z, 0.0)], axis=-1)  # (n, s, 6)
    gram = np.einsum("jsa,ksa->sjk", J, J)
    if robot.n > 6:
        gram = np.einsum("jsa,jsb->sab", J, J)
    return np.sqrt(np.maximum(np.linalg.det(gram), 0.0))


def _room(robot: Any, q: np.ndarray) -> np.ndarray:
    """Least distance from a joint's end in s postures, 1 in the middle of all, (s,)."""
    half = (robot.q_upper - robot.q_lower) / 2.0
    bounded = np.isfinite(half)
    room = np.minimum(q - robot.q_lower, robot.q_upper - q)[:, bounded] / half[bounded]
    return room.min(axis=1, initial=1.0)


def _check(
    what: str,
    joints: Sequence[str],
    q: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
) -> None:
    slack = _ROUNDING * np.maximum(1.0, np.abs(q))
    beyond = np.abs(q - np.clip(q, lower, upper))
    for j in map(int, np.flatnonzero(beyond > slack)):
        raise RobotError(
            f"{what} puts joint '{joints[j]}' at {q[j]:g}, outside its range "
            f"[{lower[j]:g}, {upper[j]:g}]: pass q_home= with a posture within the "
            "ranges"
        )
