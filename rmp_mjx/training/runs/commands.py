"""Commands of the application, for messages: training itself has none."""

from dataclasses import dataclass
from pathlib import Path


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
