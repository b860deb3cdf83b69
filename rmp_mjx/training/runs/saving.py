"""When a run saves and stops, what happens if it cannot, and what it tells to type."""

import os
import shutil
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from rmp_mjx.training.runs import run_folder
from rmp_mjx.training.runs.checkpoint import MERITS, Checkpointer, SaveError
from rmp_mjx.training.runs.metrics import Row

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


@dataclass(frozen=True)
class Commands:
    """What a user types next; None: the application has no such command."""

    resume: str | None = None
    """Continues a run. The run's folder follows, as in `python train.py --resume`."""
    replay: str | None = None
    """Replays a non-finite step. A file of `faults.dump` follows."""


def then(purpose: str, command: str | None, path: Path) -> str:
    """The end of a message: a purpose and its command; nothing without a command."""
    return f"; {purpose}\n  {command} {path}" if command else ""


class Saver:
    """Writes a run's checkpoints; one that fails is tried again at the next interval.

    A checkpoint is ranked by the episodes that finished since the previous one.
    """

    def __init__(
        self,
        checkpoints: Checkpointer | None,
        folder: Path,
        note: Callable[[str], None],
        last: int,
        commands: Commands,
    ):
        """Start from a run's last checkpoint.

        Args:
            checkpoints: Where to write them; None: another process does.
            folder: The run's folder, for messages.
            note: Called with one line if a save fails.
            last: Iteration of the last checkpoint; 0: there is none.
            commands: The application's commands, for messages.
        """
        self.last = last
        self._checkpoints = checkpoints
        self._folder = folder
        self._lock = folder / run_folder.LOCK
        self._owned = _identity(self._lock)
        self._note = note
        self._commands = commands
        self._failed = False
        self._episodes = 0
        self._sums = dict.fromkeys(MERITS, 0.0)

    def count(self, rows: Sequence[Row]) -> None:
        """Add an iteration's episodes, of all seeds, to the next checkpoint's rank."""
        for row in rows:
            finished = int(row["episode/finished"] or 0)
            self._episodes += finished
            for name in MERITS:
                self._sums[name] += finished * float(row.get(f"episode/{name}") or 0.0)

    def _merit(self) -> dict[str, float] | None:
        if not self._episodes:
            return None
        return {name: total / self._episodes for name, total in self._sums.items()}

    def save(self, iteration: int, state: Any, final: bool) -> None:
        """Save, or report the failure.

        Args:
            iteration: Finished iterations.
            state: Everything that training needs to continue.
            final: Whether this is the last save.

        Raises:
            TrainingFailure: It failed twice in a row, or at the last save; or the
                run's folder is gone.
        """
        self._check_folder(iteration)
        try:
            if self._checkpoints:
                self._checkpoints.save(iteration, state, self._merit())
        except SaveError as error:
            self._check_folder(iteration)
            problem = f"{error} ({_room(self._folder)})"
            if final or self._failed:
                raise TrainingFailure(
                    f"iteration {iteration} is not saved: {problem}; "
                    f"{self.how_to_continue()}"
                ) from error
            self._failed = True
            self._note(f"NOT SAVED, trying again at the next interval: {problem}")
            return
        self.last, self._failed = iteration, False
        self._episodes, self._sums = 0, dict.fromkeys(MERITS, 0.0)

    def _check_folder(self, iteration: int) -> None:
        """Raise TrainingFailure if the run's folder is not the one it began with."""
        if _identity(self._lock) != self._owned:
            raise TrainingFailure(
                f"iteration {iteration} is not saved: {self._folder} was removed or "
                "replaced while this run was writing to it"
            )

    def how_to_continue(self) -> str:
        """What is saved, and the command that continues from there."""
        if not self.last:
            return "nothing is saved yet"
        command = then("continue with", self._commands.resume, self._folder)
        return f"saved is iteration {self.last}{command}"


def _identity(path: Path) -> tuple[int, int] | None:
    """Device and inode of a file; None: there is none.

    Who holds a lock has the file open: no other file can have its inode.
    """
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_dev, found.st_ino


def _room(folder: Path) -> str:
    free = shutil.disk_usage(folder).free
    return f"{free / 2**20:,.0f} MiB free in {folder / run_folder.CHECKPOINTS}"
