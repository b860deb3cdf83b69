"""Why training stops early: a signal or a failure."""

import os
import signal
from types import FrameType

STOPPING = b"stopping after this iteration; a second signal exits at once\n"


class TrainingFailure(RuntimeError):
    """Training cannot continue; the message says why, and how to resume."""


class StopRequest:
    """Catches SIGINT and SIGTERM while it is active; a context manager.

    The first signal is recorded, so that the caller can finish and save. A second one
    ends the process at once.
    """

    def __init__(self) -> None:
        """Nothing is caught before the context is entered."""
        self.signal: int | None = None
        self._previous: dict[int, object] = {}

    @property
    def exit_code(self) -> int:
        """128 plus the signal's number, as shells report it; 0 without a signal."""
        return 128 + self.signal if self.signal else 0

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.signal = number
        for each in self._previous:
            signal.signal(each, signal.SIG_DFL)
        os.write(2, STOPPING)  # a handler may not touch the terminal's buffers

    def __enter__(self) -> "StopRequest":
        for number in (signal.SIGINT, signal.SIGTERM):
            self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *exc: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # pyright: ignore[reportArgumentType]
