"""The joints' own forces in the file: dampers and springs, and dry friction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from rmp_mjx.robot.errors import warn


class PassiveForces(NamedTuple):
    """Linear dampers and springs of the chain; None where every joint has zero."""

    damping: np.ndarray | None = None
    """Viscous damping, (n,) [N m s/rad or N s/m]."""
    stiffness: np.ndarray | None = None
    """Spring stiffness, (n,) [N m/rad or N/m]."""
    spring_ref: np.ndarray | None = None
    """Coordinate at which each spring is slack, (n,) [rad or m]."""


def passive_forces(model: mujoco.MjModel, joints: Sequence[str]) -> PassiveForces:
    """What of the joints' own forces the controllers can compensate.

    Warns of what they cannot: dry friction, whose force at rest is unknown, and
    polynomial dampers and springs.

    Args:
        model: The arm, compiled.
        joints: The chain's joints.
    """
    ids = [model.joint(name).id for name in joints]
    dofs = model.jnt_dofadr[ids]
    _warn(
        joints,
        model.dof_frictionloss[dofs],
        "dry friction (frictionloss), which cannot be compensated exactly: expect the "
        "arm to stop short of its target by friction over stiffness",
    )
    curved = np.abs(model.dof_dampingpoly[dofs]).sum(1)
    curved = curved + np.abs(model.jnt_stiffnesspoly[ids]).sum(1)
    _warn(
        joints,
        curved,
        "polynomial damping or stiffness, of which only the linear part is compensated",
    )
    damping, stiffness = model.dof_damping[dofs].copy(), model.jnt_stiffness[ids].copy()
    slack = model.qpos_spring[model.jnt_qposadr[ids]].copy()
    springs = bool(np.any(stiffness))
    return PassiveForces(
        damping=damping if np.any(damping) else None,
        stiffness=stiffness if springs else None,
        spring_ref=slack if springs else None,
    )


def _warn(joints: Sequence[str], amount: np.ndarray, what: str) -> None:
    affected = [name for name, x in zip(joints, amount, strict=True) if x]
    if affected:
        warn(f"joints {affected} have {what}")
