"""Priority of a process whose ticks must not be late."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

PRIORITY = 10
"""Real-time priority that is asked for; the kernel's own threads have 50."""


def hurry(pid: int | None = None) -> bool:
    """Give all threads of a process real-time priority (`SCHED_FIFO`), on Linux.

    A busy machine then leaves them the time that they need. Call it when everything is
    compiled: what computes without a pause keeps others from the core.

    Args:
        pid: The process; default this one.

    Returns:
        Whether it was allowed: it takes root, or a limit `rtprio`.
    """
    return _schedule(pid, "SCHED_FIFO", PRIORITY)


def relax(pid: int | None = None) -> bool:
    """Give them the usual priority again."""
    return _schedule(pid, "SCHED_OTHER", 0)


def _schedule(pid: int | None, policy: str, priority: int) -> bool:
    if not hasattr(os, policy):
        return False
    tasks = Path(f"/proc/{pid or os.getpid()}/task")
    for task in tasks.iterdir() if tasks.is_dir() else ():
        with contextlib.suppress(ProcessLookupError):  # a thread that has ended
            try:
                param = os.sched_param(priority)
                os.sched_setscheduler(int(task.name), getattr(os, policy), param)
            except PermissionError:
                return False
    return tasks.is_dir()
