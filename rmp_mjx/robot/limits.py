"""Limits that MJCF has no attribute for: custom numbers of the file."""

from __future__ import annotations

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
    names = [model.numeric(k).name for k in range(model.nnumeric)]
    if name not in names:
        return None
    return positive(f"numeric '{name}'", np.array(model.numeric(name).data), n)
