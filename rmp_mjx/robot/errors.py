"""What `Robot.from_mjcf` refuses, and what it warns of."""

import sys
import warnings
from collections.abc import Sequence

import numpy as np


class RobotError(ValueError):
    """The MJCF, or a name or number given with it, cannot serve as a robot."""


class RobotWarning(UserWarning):
    """The MJCF says something that the robot leaves out or decides by itself."""


def warn(message: str) -> None:
    """Issue a `RobotWarning` that points at the line outside this package."""
    level, frame = 1, sys._getframe()
    inside = ("rmp_mjx.", "jaxtyping.")  # jaxtyping may wrap what it checks
    while frame is not None and frame.f_globals["__name__"].startswith(inside):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, RobotWarning, stacklevel=level)


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


def positive(name: str, given: Numbers, size: int) -> np.ndarray:
    """The numbers as an array (size,), all of them positive.

    Raises:
        RobotError: They are not that many, not finite, or not positive.
    """
    x = vector(name, given, size)
    if np.min(x, initial=np.inf) <= 0:
        raise RobotError(f"{name} must be positive, got {x.tolist()}")
    return x
