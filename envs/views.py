"""Where a task is seen from, and what its pictures mark."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

Color = tuple[float, float, float, float]
"""Red, green, blue and opacity, each 0 to 1."""

REACHED: Color = (0.15, 0.65, 0.3, 0.55)
CURRENT: Color = (0.1, 0.45, 0.95, 0.95)
LATER: Color = (0.1, 0.45, 0.95, 0.35)
GOAL: Color = (0.15, 0.65, 0.3, 0.6)


class View(NamedTuple):
    """A camera."""

    lookat: tuple[float, float, float] = (0.25, 0.0, 0.2)
    """Point in the middle of the picture [m]."""
    distance: float = 1.4
    """Distance of the camera from it [m]."""
    azimuth: float = 143.0
    """Direction of view in the horizontal plane [degrees]."""
    elevation: float = -22.0
    """Direction of view against the horizontal plane [degrees]."""


FRONT = View()
"""The usual view: from beyond the workspace, at the arm's right."""


class Mark(NamedTuple):
    """Something that the policy must reach."""

    shape: Literal["ball", "disc"]
    """A ball, or a thin upright cylinder."""
    place: Float[np.ndarray, " 3"]
    """Its centre [m]."""
    radius: float
    """Its radius [m]."""
    color: Color
    """Its colour."""
