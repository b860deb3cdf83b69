"""What `Robot.from_mjcf` refuses, and what it warns of."""

import sys
import warnings


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
