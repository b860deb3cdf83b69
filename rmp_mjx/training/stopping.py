"""Stopping on a signal: finish the iteration, save, then go."""

import signal
from types import FrameType


class StopRequest:
    """Catches SIGINT and SIGTERM while it is active; a context manager.

    The first signal is only noted, so that the caller can finish and save; a second
    one ends the process at once.
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
        signal.signal(number, signal.SIG_DFL)

    def __enter__(self) -> "StopRequest":
        for number in (signal.SIGINT, signal.SIGTERM):
            self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *exc: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # pyright: ignore[reportArgumentType]
