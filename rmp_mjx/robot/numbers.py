"""Vectors of numbers that a user gives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rmp_mjx.robot.errors import RobotError

Numbers = Sequence[float | int] | np.ndarray
"""What stands for a vector: a list, a tuple or an array."""


def vector(name: str, given: Numbers, size: int) -> np.ndarray:
    """The numbers as an array (size,).

    Raises:
        RobotError: They are not that many, or not finite.
    """
    x = np.asarray(given, float)
    if x.shape != (size,) or not np.all(np.isfinite(x)):
        raise RobotError(f"{name} must be {size} finite numbers, got {x.tolist()}")
    return x
