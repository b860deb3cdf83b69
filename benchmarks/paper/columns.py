"""Columns of the deployment: the worlds that a trained policy is put into."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from envs.cli import REFERENCE


@dataclass(frozen=True)
class Column:
    """One world."""

    name: str
    """Its name."""
    label: str
    """What figures and tables call it."""
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the task, beside the training's."""
    physics: str | None = None
    """Physics engine; None: the training's."""


_CLOSE = {"obstacles": 2, "layout": "close"}

COLUMNS = {
    column.name: column
    for column in (
        Column("close", "2 spheres, close", _CLOSE),
        Column("far", "2 spheres, far", {"obstacles": 2, "layout": "far"}),
        Column("free", "no obstacles"),
        Column("four", "4 spheres", {"obstacles": 4, "layout": "close"}),
        Column("moving", "spheres at 0.1 m/s", _CLOSE | {"obstacle_speed": 0.1}),
        Column("noise", "1 cm noise", _CLOSE | {"obstacle_noise": 0.01}),
        Column("delay", "100 ms delay", _CLOSE | {"obstacle_delay": 0.1}),
        Column("engine", "2nd engine", _CLOSE | REFERENCE["mujoco"], "mujoco"),
        Column("armature", "robosuite armature", _CLOSE | {"armature": "robosuite"}),
    )
}
"""Columns by name; all but the first three are among two close spheres but for what
their label says."""

TABLE = ("close", "far")
"""The columns of the deployment table."""
PICTURED = "close"
"""The column whose first episodes are recorded: pictures, and what each event was."""
