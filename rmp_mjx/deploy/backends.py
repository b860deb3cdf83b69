"""What a loop asks of a robot, and a robot that two functions talk to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, Protocol

import numpy as np

State = tuple[np.ndarray, np.ndarray]
"""Joint positions (n,) [rad] and velocities (n,) [rad/s]."""

Pace = Literal["loop", "robot", "simulation"]
"""loop: it reads when a tick is due; robot: `read` waits for the robot's next tick;
simulation: `read` returns at once, and a tick takes exactly a period."""


class Backend(Protocol):
    """A robot under torque control."""

    @property
    def pace(self) -> Pace:
        """Who keeps time."""
        ...

    @property
    def carries_weight(self) -> bool:
        """Whether the robot adds what holds it against gravity, which is not sent."""
        ...

    def read(self) -> State:
        """The state now."""
        ...

    def write(self, tau: np.ndarray, /) -> None:
        """Send torques, (n,) [N m]."""
        ...

    def finish(self, tau: np.ndarray, /) -> None:
        """Send the last torques; the robot holds itself from then on."""
        ...


class CallbackBackend:
    """A robot that two functions talk to."""

    def __init__(
        self,
        read: Callable[[], State],
        write: Callable[[np.ndarray], None],
        finish: Callable[[np.ndarray], None] | None = None,
        pace: Pace = "loop",
        carries_weight: bool = False,
    ):
        """Keep the functions.

        Args:
            read: Gives joint positions and velocities.
            write: Takes torques, (n,) [N m].
            finish: Takes the last torques and engages what holds the arm; default:
                `write`, and the robot must hold the last torque itself.
            pace: See `Backend`.
            carries_weight: See `Backend`.
        """
        self.read, self.write = read, write
        self.finish = finish or write
        self.pace: Pace = pace
        self.carries_weight = carries_weight
