"""Limits that MJCF has no attribute for: custom numbers, and URDF's velocities."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from rmp_mjx.robot.errors import Numbers, positive


def rated(
    model: mujoco.MjModel, name: str, given: Numbers | None, n: int
) -> np.ndarray | None:
    """A limit of every joint, from the argument or else from the file; None for none.

    A file gives it as ``<custom><numeric name="velocity_limits" data="..."/></custom>``
    with one positive number for each joint of the chain, base first.

    Args:
        model: The arm, compiled.
        name: `velocity_limits` [rad/s or m/s], `torque_rate_limits` [N m/s or N/s], or
            for the record `acceleration_limits` and `jerk_limits`.
        given: Numbers that replace the file's, (n,).
        n: Number of joints.

    Raises:
        RobotError: They are not n positive numbers.
    """
    if given is not None:
        return positive(name, given, n)
    numbers = recorded(model)
    if name not in numbers:
        return None
    return positive(f"numeric '{name}'", numbers[name], n)


def recorded(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """All custom numbers of a file by name."""
    found = [model.numeric(k) for k in range(model.nnumeric)]
    return {numeric.name: np.array(numeric.data) for numeric in found}


def urdf_velocities(path: object, joints: Sequence[str]) -> list[float] | None:
    """Velocity limits of a URDF file, which MuJoCo does not keep; None if it has none.

    Args:
        path: The model; anything but the path of a `.urdf` has none.
        joints: Names of the joints, (n,).
    """
    if not (isinstance(path, (str, Path)) and str(path).endswith(".urdf")):
        return None
    found = {
        str(joint.get("name")): float(limit.get("velocity", "nan"))
        for joint in ElementTree.parse(path).iter("joint")
        if (limit := joint.find("limit")) is not None
    }
    limits = [found.get(name, np.nan) for name in joints]
    return limits if np.all(np.isfinite(limits)) and min(limits) > 0 else None
