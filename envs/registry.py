"""The tasks by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from rmp_mjx.files import with_tuples
from rmp_mjx.names import unknown
from rmp_mjx.robot import Robot

from . import outside
from .base import ArmEnv
from .door import Door
from .options import Options
from .push import Push
from .trajectory import Trajectory

ENVS: dict[str, type[ArmEnv]] = {
    task.Options.env: task for task in (Trajectory, Door, Push)
}
"""The tasks of this package by name."""


def names() -> tuple[str, ...]:
    """The tasks that come with this package."""
    return tuple(ENVS)


def make_options(env: str, **options: Any) -> Options:
    """The options of a task, checked; builds nothing.

    Args:
        env: Name of a task, as in `task`.
        **options: Fields of the task's options, for instance `controller`, `physics`,
            `obstacles`; see `envs.options.Options` and the task's module.

    Raises:
        ValueError: Unknown task, option, or value; the message lists the valid ones.
    """
    kind = task(env).Options
    valid = [field.name for field in dataclasses.fields(kind)]
    for name in options:
        if name not in valid:
            raise ValueError(unknown(f"option of '{env}'", name, valid))
    return kind(**with_tuples(options))


def recorded(record: Mapping[str, Any]) -> Options:
    """The options of a task from their record in a file.

    Raises:
        ValueError: As in `make_options`, or the task is a `module:Class` that nobody
            has named in this process: files make it import nothing.
    """
    outside.check_recorded(record["env"])
    return make_options(**record)


def make(
    options: Options, robot: Robot | None = None, controller: Any = None
) -> ArmEnv:
    """Make the task that the options describe.

    Args:
        options: Options of the task.
        robot: An arm object instead of the options' named one. It is taken as it is:
            its base is the origin, and it starts at its `q_home`.
        controller: A controller object instead of the options' named one.
    """
    return task(options.env)(options, robot, controller)


def load(
    name: str,
    *,
    robot: Robot | str | None = None,
    controller: Any = None,
    **options: Any,
) -> ArmEnv:
    """Make a task by name.

    Args:
        name: Name of a task, as in `task`.
        robot: Name or path of an arm, as the option; or an arm object, as in `make`.
        controller: Name of a controller, or a controller object.
        **options: More of the task's options, as in `make_options`.

    Raises:
        ValueError: Unknown task, option, or value; the message lists the valid ones.
    """
    if isinstance(controller, str):
        options["controller"], controller = controller, None
    if isinstance(robot, str):
        options["robot"], robot = robot, None
    return make(make_options(name, **options), robot, controller)


def task(name: str) -> type[ArmEnv]:
    """The class of a task.

    Args:
        name: One of `names()`, a task of an installed package by its name, or a class
            of your own as `module:Class`, which is imported; see `docs/add_a_task.md`.

    Raises:
        ValueError: Unknown task, or one that cannot be used; the message lists the
            valid ones, or says what is wrong.
    """
    return ENVS[name] if name in ENVS else outside.find(name, names())


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
