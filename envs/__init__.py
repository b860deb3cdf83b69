"""Batched manipulation tasks. `load` makes one by name."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from envs import options as _options
from envs.base import ArmEnv as ArmEnv
from envs.door import Door
from envs.push import Push
from envs.trajectory import Trajectory
from envs.types import State as State
from rmp_mjx.names import unknown

ENVS: dict[str, type[ArmEnv]] = {task.name: task for task in (Trajectory, Door, Push)}
"""Tasks by name."""


def names() -> tuple[str, ...]:
    """The tasks that `load` knows."""
    return tuple(ENVS)


def load(name: str, **options: Any) -> ArmEnv:
    """Make a task.

    Args:
        name: One of `names()`.
        **options: Fields of the task's options, for instance `controller`, `physics`,
            `obstacles`; see `envs.options.Options` and the task's module.

    Raises:
        ValueError: Unknown task, option, or value; the message lists the valid ones.
    """
    task = _task(name)
    return task(_options.make(task.Options, name, options))


def parse_options(name: str, texts: Iterable[str]) -> dict[str, Any]:
    """Options for `load` from texts such as `layout=close`; builds nothing.

    Raises:
        ValueError: Unknown task, option, or value; the message lists the valid ones.
    """
    task = _task(name)
    options = _options.parse(task.Options, name, texts)
    _options.make(task.Options, name, options)
    return options


def describe(name: str, **options: Any) -> str:
    """A table of the task's observation: place, name, size, unit and meaning."""
    rows, start = [("entries", "name", "unit", "meaning")], 0
    for entry in load(name, **options).entries:
        place = f"{start}" if entry.size == 1 else f"{start}:{start + entry.size}"
        rows.append((place, entry.name, entry.unit, entry.meaning))
        start += entry.size
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = (
        "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )
    return "\n".join(lines)


def _task(name: str) -> type[ArmEnv]:
    if name not in ENVS:
        raise ValueError(unknown("env", name, names()))
    return ENVS[name]
