"""Time as users turn it: pause, single steps, slow motion, the last 30 seconds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, Protocol, TypeVar

REMEMBERED = 30.0
"""Length of a history [s]."""
LATE = 0.1
"""Time that is made up for at most; what is later is lost [s]."""

FrameT = TypeVar("FrameT")


class Simulation(Protocol[FrameT]):
    """What a player plays, frame by frame."""

    @property
    def period(self) -> float:
        """Simulated time from one frame to the next [s]."""
        ...

    @property
    def history(self) -> Sequence[FrameT]:
        """The last frames, at most `REMEMBERED` long, the newest one last."""
        ...

    def step(self) -> FrameT:
        """Make the next frame, which is then the newest one."""
        ...

    def restore(self, frame: FrameT) -> None:
        """Go on from a frame; what came after it is forgotten."""
        ...


def kept(period: float) -> int:
    """Number of frames in `REMEMBERED`."""
    return round(REMEMBERED / period)


class Player(Generic[FrameT]):
    """Steps a simulation as the wall clock asks, and knows what is shown of it."""

    def __init__(self, simulation: Simulation[FrameT]):
        """Play at full speed; nothing is stepped before the first `advance`."""
        self.simulation = simulation
        self.paused, self.speed = False, 1.0
        self.pace = 0.0
        """Simulated per wall time of late, smoothed."""
        self.shown: FrameT | None = None
        """What is shown; None: the next frame."""
        self._owed = 0.0

    def advance(self, elapsed: float) -> FrameT:
        """Take the steps that are due; returns what is shown.

        Args:
            elapsed: Wall time since the last call [s].
        """
        if not self.paused:
            period = self.simulation.period
            self._owed += min(elapsed, LATE) * self.speed
            steps = int(self._owed / period)
            self._owed -= steps * period
            for _ in range(steps):
                self.shown = self.simulation.step()
            made = steps * period / max(elapsed, 1e-6)
            self.pace += 0.05 * (made - self.pace)
        if self.shown is None:
            self.shown = self.simulation.step()
        return self.shown

    def once(self) -> None:
        """Pause, and go on by one step."""
        self.paused, self.shown = True, self.simulation.step()

    def look_back(self, seconds: float) -> None:
        """Show what was so long ago [s], paused; 0: the newest frame."""
        self.paused |= seconds > 0.0
        history = self.simulation.history
        if history:
            ago = min(round(seconds / self.simulation.period), len(history) - 1)
            self.shown = history[-1 - ago]

    def go_on_from_there(self) -> None:
        """Let the simulation go on from what is shown."""
        if self.shown is not None:
            self.simulation.restore(self.shown)
        self.paused = False
