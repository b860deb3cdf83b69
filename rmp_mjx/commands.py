"""The console commands of the installed package, the only ones to know the tasks.

They need more than the library does, so each imports what it needs when it starts.
"""

import contextlib
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def _extra(name: str) -> Iterator[None]:
    """Imports of an extra; one that is missing ends the command with exit code 2."""
    try:
        yield
    except ImportError as missing:
        sys.stderr.write(
            f"error: this command needs the extra {name}, pip install "
            f"'rmp-mjx[{name}]': {missing}\n"
        )
        raise SystemExit(2) from missing


def train() -> int:
    """`rmp-mjx-train`."""
    with _extra("train"):
        from rmp_mjx_envs import train
    return train.main()


def evaluate() -> int:
    """`rmp-mjx-eval`."""
    with _extra("train"):
        from rmp_mjx_envs import eval as evaluation
    return evaluation.main()


def export() -> int:
    """`rmp-mjx-export`."""
    with _extra("train"):
        from rmp_mjx_envs import export
    return export.main()


def replay() -> int:
    """`rmp-mjx-replay`."""
    with _extra("train"):
        from rmp_mjx_envs import replay
    return replay.main()


def check_robot() -> int:
    """`rmp-mjx-check-robot`."""
    with _extra("train"):
        from rmp_mjx.check_robot import __main__ as check
    return check.main()
