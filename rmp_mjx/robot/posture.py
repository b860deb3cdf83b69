"""The nominal posture: given, from the file, or chosen within the joint ranges."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rmp_mjx.robot.errors import Numbers, RobotError, vector, warn

CLOSE = 0.1
"""Part of a joint's range, at either end, that a chosen posture keeps out of."""

_ROUNDING = 1e-5
"""Allowed overshoot: MuJoCo writes ranges with six digits."""


def nominal_posture(
    joints: Sequence[str],
    lower: np.ndarray,
    upper: np.ndarray,
    q_ref: np.ndarray,
    home: dict[str, float] | None,
    given: Numbers | None,
) -> np.ndarray:
    """Joint coordinates of the posture that the arm prefers and tasks start at.

    The first of these that there is: the one given, keyframe `home`, the reference
    pose. In the reference pose, joints that lie outside their range or close to its
    ends go to the middle of it, with a warning.

    Args:
        joints: Names of the joints.
        lower: Lower limits, (n,) [rad or m]; -inf for none.
        upper: Upper limits, (n,).
        q_ref: Reference pose, (n,).
        home: Keyframe `home` by joint, if the file has it.
        given: Posture that replaces the file's, (n,).

    Returns:
        The posture, (n,).

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
    limited = np.isfinite(lower) & np.isfinite(upper)
    low, high = np.where(limited, lower, 0.0), np.where(limited, upper, 0.0)
    margin = CLOSE * (high - low)
    bad = limited & ((q_ref < low + margin) | (q_ref > high - margin))
    if bad.any():
        names = ", ".join(
            f"'{joints[j]}' ({q_ref[j]:g}, range [{low[j]:g}, {high[j]:g}])"
            for j in map(int, np.flatnonzero(bad))
        )
        warn(
            "there is no keyframe 'home', and the reference pose is outside or near "
            f"the end of the range of {names}: these joints rest at mid-range. Pass "
            "q_home= to choose a posture"
        )
    return np.where(bad, (low + high) / 2.0, q_ref)


def _check(
    what: str,
    joints: Sequence[str],
    q: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
) -> None:
    slack = _ROUNDING * np.maximum(1.0, np.abs(q))
    for j in map(int, np.flatnonzero((q < lower - slack) | (q > upper + slack))):
        raise RobotError(
            f"{what} puts joint '{joints[j]}' at {q[j]:g}, outside its range "
            f"[{lower[j]:g}, {upper[j]:g}]: pass q_home= with a posture within the "
            "ranges"
        )
