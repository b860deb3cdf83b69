"""Batched manipulation tasks. `load` makes one by name."""

from __future__ import annotations

import inspect

from envs.base import ArmEnv as ArmEnv
from envs.base import State as State
from envs.trajectory import Trajectory
from rmp_mjx.robot.mjcf import unknown

ENVS: dict[str, type[ArmEnv]] = {"trajectory": Trajectory}
"""Tasks by name."""


def names() -> tuple[str, ...]:
    """The tasks that `load` knows."""
    return tuple(ENVS)


def load(name: str, **options) -> ArmEnv:
    """Make a task.

    Args:
        name: One of `names()`.
        **options: The task's keyword arguments, for instance `controller`, `physics`,
            `obstacles`; see the task's class.

    Raises:
        ValueError: Unknown task, option, or value; the message lists the valid ones.
    """
    if name not in ENVS:
        raise ValueError(unknown("env", name, names()))
    valid = list(inspect.signature(ENVS[name]).parameters)
    for option in options:
        if option not in valid:
            raise ValueError(unknown(f"option of '{name}'", option, valid))
    return ENVS[name](**options)
