"""Quantities that cross module borders, each field with its shape and unit."""

from __future__ import annotations

from typing import Any

from jaxtyping import Array, Float

from rmp_mjx.pytree import Constant as Constant
from rmp_mjx.pytree import Pytree


class LeafWeights(Pytree):
    """How a policy shapes the tree, within bounds (`WeightedActionRange`)."""

    attractor: Float[Constant, ""]
    """Factor on the metric of the impedance attractors, at most 1."""
    posture: Float[Constant, ""]
    """Factor on the metric of the posture."""
    standoff: Float[Constant, ""]
    """Added to the margins of the leaves that avoid obstacles, at least 0 [m]."""


class Action(Pytree):
    """One variable-impedance action in physical units (VICES action space)."""

    dpos: Float[Constant, " 3"]
    """Displacement of the end effector from its current position, world frame [m]."""
    drot: Float[Constant, " 3"]
    """Rotation from the current orientation, world-frame axis-angle [rad]."""
    kp_pos: Float[Constant, " 3"]
    """Mass-normalised translational stiffness per world axis [1/s^2]."""
    kp_ori: Float[Constant, " 3"]
    """Mass-normalised rotational stiffness per world axis [1/s^2]."""
    weights: LeafWeights | None = None
    """Weights of the tree's leaves; None: as the controller has them."""


class Setpoint(Pytree):
    """Impedance target of the end effector, held between two policy steps."""

    p_des: Float[Constant, " 3"]
    """Desired site position, world frame [m]."""
    R_des: Float[Constant, "3 3"]
    """Desired site orientation, world frame."""
    kp_pos: Float[Constant, " 3"]
    """Translational stiffness [1/s^2]."""
    kp_ori: Float[Constant, " 3"]
    """Rotational stiffness [1/s^2]."""
    time: Float[Constant, ""] | float
    """Time of the policy step since the start of the episode [s]. It is the phase of
    `SetpointDither`, which stands still if the time does."""
    weights: LeafWeights | None = None
    """Weights of the tree's leaves; None: as the controller has them."""


class ControlOutput(Pytree):
    """What a controller returns for one state."""

    tau: Float[Array, " n"]
    """Joint torques within the actuator limits [N m]."""
    qdd: Float[Array, " n"]
    """Joint acceleration that the torque gives while nothing touches [rad/s^2]."""
    f: Float[Array, " n"]
    """Force of the root RMP (natural form)."""
    M: Float[Array, "n n"]
    """Metric of the root RMP (natural form), without the regulariser."""
    Mq: Float[Array, "n n"]
    """Inertia of the arm in this state [kg m^2]."""
    bias: Float[Array, " n"]
    """Coriolis and gravity torques in this state [N m]: the model is
    ``Mq qdd + bias = tau + tau_ext``."""
    diagnostics: dict[str, Any]
    """By name. Every controller has `torque_limit` (n,): -1 or 1 where a torque is at
    its lower or upper limit, else 0; and `usable`: 1 where its inputs could be used, 0
    where the torque is a fall-back (docs/fail_safe.md). It documents the others."""
