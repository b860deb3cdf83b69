"""The small file with an arm's parameters that `Robot.load` takes."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rmp_mjx.files import write_text
from rmp_mjx.robot import Robot
from rmp_mjx.robot.library import FILES

_ABOUT = {
    "q_home": "nominal posture [rad or m]",
    "torque_limits": "[N m or N]",
    "velocity_limits": "[rad/s or m/s]",
    "torque_rate_limits": "[N m/s or N/s]",
}


def write_parameters(
    path: Path, robot: Robot, model: str, given: Mapping[str, Any]
) -> None:
    """Write what `Robot.load(path)` needs to make this arm again.

    Args:
        path: The file, `.toml`; a model's path becomes relative to its folder.
        robot: The arm.
        model: Its name or path.
        given: The options that it was loaded with.
    """
    if model.endswith((*FILES, ".toml")):
        model = Path(os.path.relpath(model, path.parent)).as_posix()
    found = {
        "q_home": robot.q_home,
        "torque_limits": robot.tau_max,
        "velocity_limits": robot.qd_max,
        "torque_rate_limits": robot.tau_rate_max,
    }
    lines = ["# An arm of rmp_mjx: Robot.load takes this file.", f'model = "{model}"']
    for key, value in {**given, **found}.items():
        if value is not None:
            about = f"  # {_ABOUT[key]}" if key in _ABOUT else ""
            lines.append(f"{key} = {_toml(value)}{about}")
    write_text(path, "\n".join(lines) + "\n")


def _toml(value: Any) -> str:
    """A text, a number or a list of numbers; JSON writes these as TOML does."""
    return json.dumps(np.asarray(value).tolist())
