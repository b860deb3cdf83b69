"""One torque motor per joint, whatever the file has, and the joints' passive forces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from rmp_mjx.robot.errors import Numbers, RobotError, positive, warn

_ON_JOINT = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)


def drives(actuator: mujoco.MjsActuator, joint: str) -> bool:
    """Whether the actuator acts on this joint."""
    return actuator.trntype in _ON_JOINT and actuator.target == joint


def make_motors(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    joints: Sequence[str],
    given: Numbers | None,
) -> None:
    """Replace the chain's actuators by motors, in the order of the joints.

    A motor has a gear of 1, so that its control is the joint's torque [N m], and a
    control range of plus and minus its limit. The actuators keep their names; their
    rotor inertia and damping pass to the joints. A file that has just these motors
    stays as it is.

    Args:
        spec: The arm; edited.
        model: The same, compiled.
        joints: The chain's joints, base first.
        given: Torque limits that replace the file's, (n,) [N m or N].

    Raises:
        RobotError: A limit is missing or not positive, or a joint has no actuator or
            several.
    """
    groups = [[a for a in spec.actuators if drives(a, name)] for name in joints]
    if given is None:
        limits = [
            _limit(model, name, group)
            for name, group in zip(joints, groups, strict=True)
        ]
    else:
        limits = positive("torque_limits", given, len(joints)).tolist()
        for name in joints:  # else the simulation would still apply the file's
            if model.jnt_actfrclimited[model.joint(name).id]:
                spec.joint(name).actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    ids = [[a.id for a in group] for group in groups]
    if ids == [[k] for k in range(len(joints))] and all(
        _is_motor(model, a, limit)
        for group, limit in zip(groups, limits, strict=True)
        for a in group
    ):
        return
    names = [group[0].name if len(group) == 1 else "" for group in groups]
    _move_losses_to_joints(spec, model, joints, groups)
    for group in groups:
        for actuator in group:
            spec.delete(actuator)
    for name, joint, limit in zip(names, joints, limits, strict=True):
        _add_motor(spec, name, joint, limit)


def _add_motor(spec: mujoco.MjSpec, name: str, joint: str, limit: float) -> None:
    """Every attribute is set: the file's default class must not leak in."""
    motor = spec.add_actuator(name=name)
    motor.set_to_motor()
    motor.trntype, motor.target = mujoco.mjtTrn.mjTRN_JOINT, joint
    motor.gear = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    motor.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
    motor.ctrlrange = [-limit, limit]
    motor.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE
    motor.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
    motor.armature, motor.damping = 0.0, np.zeros(3)
    motor.nsample, motor.delay = 0, 0.0


def _is_motor(
    model: mujoco.MjModel, actuator: mujoco.MjsActuator, limit: float
) -> bool:
    """Whether control is torque, within exactly the limit."""
    a = actuator.id
    return bool(
        _kind(model, a) == "motor"
        and model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
        and model.actuator_dyntype[a] == mujoco.mjtDyn.mjDYN_NONE
        and model.actuator_gainprm[a, 0] == 1.0
        and model.actuator_gear[a, 0] == 1.0
        and model.actuator_ctrllimited[a]
        and np.all(model.actuator_ctrlrange[a] == [-limit, limit])
        and not (actuator.armature or np.any(actuator.damping) or actuator.nsample)
    )


def _kind(model: mujoco.MjModel, a: int) -> str:
    """What MJCF calls an actuator like this one."""
    gain, bias = mujoco.mjtGain, mujoco.mjtBias
    _, place, speed = model.actuator_biasprm[a, :3]
    feedback = "position" if place else "velocity" if speed else "general"
    kinds = {
        (gain.mjGAIN_FIXED, bias.mjBIAS_NONE): "motor",
        (gain.mjGAIN_FIXED, bias.mjBIAS_AFFINE): feedback,
    }
    own = gain(model.actuator_gaintype[a]), bias(model.actuator_biastype[a])
    return kinds.get(own, "general")


def _limit(
    model: mujoco.MjModel, joint: str, group: Sequence[mujoco.MjsActuator]
) -> float:
    """Largest torque, either way, that the joint's one actuator can give.

    A joint without one may have a limit itself: so a URDF gives it.
    """
    joint_id = model.joint(joint).id
    if not group and model.jnt_actfrclimited[joint_id]:
        limit = float(min(abs(model.jnt_actfrcrange[joint_id])))
        if limit:
            return limit
    if len(group) != 1:
        names = f" ({', '.join(repr(a.name) for a in group)})" if group else ""
        raise RobotError(
            f"joint '{joint}' has {len(group)} actuators{names}: it needs one "
            "actuator, or pass torque_limits="
        )
    (actuator,) = group
    a, name = actuator.id, actuator.name or f"on joint {joint}"
    kind, gear = _kind(model, a), model.actuator_gear[a, 0]
    ranges = []
    if model.actuator_forcelimited[a]:
        ranges.append(gear * model.actuator_forcerange[a])
    if model.jnt_actfrclimited[joint_id]:
        ranges.append(model.jnt_actfrcrange[joint_id])
    if kind == "motor" and model.actuator_ctrllimited[a]:
        gain = model.actuator_gainprm[a, 0]
        ranges.append(gain * gear * model.actuator_ctrlrange[a])
    if not ranges:
        motor = kind == "motor"
        what = "a motor" if motor else f"a {kind} actuator"
        missing = "ctrlrange or forcerange" if motor else "forcerange"
        raise RobotError(
            f"actuator '{name}' is {what} without {missing}, so that its torque limit "
            "is unknown: give it one, or pass torque_limits="
        )
    if kind == "motor" and model.actuator_dyntype[a] != mujoco.mjtDyn.mjDYN_NONE:
        warn(
            f"motor '{name}' has activation dynamics, which are left out: its torque "
            "acts at once"
        )
    limit = float(min(min(-min(r), max(r)) for r in ranges))
    if not limit > 0:
        shown = ", ".join(f"[{min(r):g}, {max(r):g}]" for r in ranges)
        raise RobotError(
            f"actuator '{name}' cannot push both ways: its torque range is {shown}"
        )
    return limit


def _move_losses_to_joints(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    joints: Sequence[str],
    groups: Sequence[Sequence[mujoco.MjsActuator]],
) -> None:
    """Reflect the actuators' rotor inertia and damping to their joints."""
    for name, group in zip(joints, groups, strict=True):
        joint = spec.joint(name)
        for actuator in group:
            square = model.actuator_gear[actuator.id, 0] ** 2
            joint.armature = joint.armature + square * actuator.armature
            reflected = square * np.asarray(actuator.damping)
            joint.damping = np.asarray(joint.damping) + reflected


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
    curved = model.dof_dampingpoly[dofs].any(1) | model.jnt_stiffnesspoly[ids].any(1)
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
