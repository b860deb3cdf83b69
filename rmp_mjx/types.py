"""Quantities that cross module borders, each field with its shape and unit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Array, Float

from rmp_mjx.pytree import Pytree

# Constants are float64 NumPy arrays until traced, so that they serve any precision.
if TYPE_CHECKING:
    from typing import Any as Constant
else:
    Constant = Array | np.ndarray


class Action(Pytree):
    """One variable-impedance action in physical units (VICES action space)."""

    dpos: Float[Array, " 3"]
    """Displacement of the end effector from its current position, world frame [m]."""
    drot: Float[Array, " 3"]
    """Rotation from the current orientation, world-frame axis-angle [rad]."""
    kp_pos: Float[Array, " 3"]
    """Mass-normalised translational stiffness per world axis [1/s^2]."""
    kp_ori: Float[Array, " 3"]
    """Mass-normalised rotational stiffness per world axis [1/s^2]."""


class Setpoint(Pytree):
    """Impedance target of the end effector, held between two policy steps."""

    p_des: Float[Array, " 3"]
    """Desired site position, world frame [m]."""
    R_des: Float[Array, "3 3"]
    """Desired site orientation, world frame."""
    kp_pos: Float[Array, " 3"]
    """Translational stiffness [1/s^2]."""
    kp_ori: Float[Array, " 3"]
    """Rotational stiffness [1/s^2]."""
    time: Float[Array, ""] | float = 0.0
    """Time of the policy step [s]: what a controller that stirs goes by."""


class ControlOutput(Pytree):
    """What a controller answers for one state."""

    tau: Float[Array, " n"]
    """Joint torques within the actuator limits [N m]."""
    qdd: Float[Array, " n"]
    """Desired joint acceleration, before the torque limits [rad/s^2]."""
    f: Float[Array, " n"]
    """Force of the root RMP (natural form)."""
    M: Float[Array, "n n"]
    """Metric of the root RMP (natural form), without the regulariser."""
    diagnostics: dict[str, Any]
    """Scalars worth watching: `torque_scale` in [0, 1] (1 = no saturation) and
    `clearance` [m], the least distance of a control point to an obstacle."""
