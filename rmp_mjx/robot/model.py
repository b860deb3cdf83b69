"""From an MJCF with a serial chain to the arrays that the controller needs."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources
from pathlib import Path

import mujoco
import numpy as np
from flax import struct
from jaxtyping import Float

from rmp_mjx.names import unknown
from rmp_mjx.pytree import Pytree
from rmp_mjx.robot.control_points import (
    Capsules,
    ControlPoints,
    body_capsules,
    sample_control_points,
    touching_pairs,
)
from rmp_mjx.robot.mjcf import (
    RobotError,
    compile_text,
    home_configuration,
    lock_other_joints,
    read_spec,
)
from rmp_mjx.types import Constant

ARMATURE = {
    "physical": None,
    "robosuite": [5.0 / (i + 1) for i in range(7)],
}
"""Rotor inertias of the Jaco 2 [kg m^2]: the file's own, or robosuite's 5/(i+1)."""

SPACING = 0.0135
"""Default distance between control points [m]: about 64 of them on the Jaco 2."""


class Robot(Pytree):
    """A fixed-base serial arm: constants of its kinematics, dynamics and geometry.

    Each joint has a frame on its axis with z along it; everything that moves with a
    joint is expressed there, so that forward kinematics is one constant transform and
    one rotation about z (or shift along z) per joint.
    """

    offset: Float[Constant, "n 3"]
    """Joint frame's origin in the previous joint's frame, at the reference pose [m]."""
    rotation: Float[Constant, "n 3 3"]
    """Joint frame's rotation in the previous joint's frame, at the reference pose."""
    q_ref: Float[Constant, " n"]
    """Joint coordinates of the reference pose (MuJoCo's qpos0) [rad or m]."""
    q_home: Float[Constant, " n"]
    """Nominal posture: keyframe `home`, else q_ref."""
    q_lower: Float[Constant, " n"]
    """Lower joint limits; -inf for an unlimited joint."""
    q_upper: Float[Constant, " n"]
    """Upper joint limits; +inf for an unlimited joint."""
    tau_max: Float[Constant, " n"]
    """Actuator limits [N m or N]."""
    mass: Float[Constant, " n"]
    """Mass that moves rigidly with each joint [kg]."""
    com: Float[Constant, "n 3"]
    """Its centre, in the joint frame [m]."""
    inertia: Float[Constant, "n 3 3"]
    """Its rotational inertia about that centre, in the joint frame [kg m^2]."""
    armature: Float[Constant, " n"]
    """Rotor inertia added to the diagonal of Mq [kg m^2 or kg]."""
    gravity: Float[Constant, " 3"]
    """Gravity in the world frame [m/s^2]."""
    site_offset: Float[Constant, " 3"]
    """End-effector site in the last joint's frame [m]."""
    site_rotation: Float[Constant, "3 3"]
    """Its rotation there."""
    points: ControlPoints
    """Control points on the moving links."""
    capsules: Capsules
    """Link capsules, for self-collision."""
    hinge: tuple[bool, ...] = struct.field(pytree_node=False)
    """Whether each joint is a hinge (else a slide)."""
    joint_names: tuple[str, ...] = struct.field(pytree_node=False)
    """Joints of the chain, base first."""
    site_name: str = struct.field(pytree_node=False)
    """The end-effector site."""
    body_names: tuple[str, ...] = struct.field(pytree_node=False)
    """Bodies of the arm that carry capsules."""
    mjcf: str = struct.field(pytree_node=False)
    """The arm-only model as MJCF text."""

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def mj_model(self) -> mujoco.MjModel:
        """The arm-only model, compiled by MuJoCo C (a new copy each time)."""
        return mujoco.MjModel.from_xml_string(self.mjcf)

    @property
    def control_points(self) -> list[tuple[str, np.ndarray, float]]:
        """(body name, offset in the body frame [m], radius [m]) of each point."""
        return [
            (body, np.asarray(offset), float(radius))
            for body, offset, radius in zip(
                self.points.body,
                np.asarray(self.points.body_offset),
                np.asarray(self.points.radius),
                strict=True,
            )
        ]

    @staticmethod
    def load(name: str = "jaco2", armature: str = "physical", **kwargs) -> Robot:
        """Load a robot that ships with the library.

        Args:
            name: `jaco2`.
            armature: `physical` (geared actuators, the default) or `robosuite`, which
                adds 5/(i+1) kg m^2 to joint i and so dominates the arm's inertia.
            **kwargs: Passed to `from_mjcf` (for instance `spacing`).

        Raises:
            RobotError: Unknown name or armature setting.
        """
        if name != "jaco2":
            raise RobotError(unknown("robot", name, ["jaco2"]))
        if armature not in ARMATURE:
            raise RobotError(unknown("armature setting", armature, list(ARMATURE)))
        path = resources.files("rmp_mjx.robot") / "jaco2" / "jaco2.xml"
        options = {"site": "grip", "armature": ARMATURE[armature]} | kwargs
        return Robot.from_mjcf(str(path), **options)

    @staticmethod
    def from_mjcf(
        path: str | Path,
        site: str,
        joints: Sequence[str] | None = None,
        links: Sequence[str] | None = None,
        *,
        armature: Sequence[float] | None = None,
        torque_limits: Sequence[float] | None = None,
        spacing: float = SPACING,
    ) -> Robot:
        """Build a robot from any MJCF with a serial chain of hinge or slide joints.

        Joints that are not on the chain from the world to the site (fingers, say) are
        locked at their reference position.

        Args:
            path: MJCF file, or MJCF text.
            site: End-effector site; the chain runs from the world to its body.
            joints: The chain's joints, base first; default all of them.
            links: Bodies that carry control points; default all with geoms.
            armature: Rotor inertias that replace the file's [kg m^2].
            torque_limits: Actuator limits [N m] where the file gives none.
            spacing: Distance between control points along a link's capsules [m].

        Raises:
            RobotError: A name is unknown, the chain has a joint that is neither hinge
                nor slide, or the actuators are not one limited motor per joint.
        """
        spec = read_spec(path)
        home = home_configuration(spec)
        spec, joints = lock_other_joints(spec, site, joints)
        if armature is not None:
            if len(armature) != len(joints):
                raise RobotError(
                    f"armature has {len(armature)} entries for {len(joints)} joints"
                )
            for name, value in zip(joints, armature, strict=True):
                spec.joint(name).armature = value
        model, mjcf = compile_text(spec)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        ids = [model.joint(name).id for name in joints]
        frames_p = np.array([data.xanchor[j] for j in ids])
        frames_R = np.array([_frame_with_z(data.xaxis[j]) for j in ids])
        segment = _segments(model, ids)
        mass, com, inertia = _lumped_inertias(model, data, segment, frames_p, frames_R)
        carriers = _carriers(model, segment, links)
        capsules, bodies = body_capsules(
            model, data, segment, frames_p, frames_R, carriers
        )
        limited = model.jnt_limited[ids].astype(bool)
        site_id = model.site(site).id
        R_last = frames_R[-1]
        prev_p = np.vstack([np.zeros(3), frames_p[:-1]])
        prev_R = np.concatenate([np.eye(3)[None], frames_R[:-1]])
        return Robot(
            offset=np.einsum("nji,nj->ni", prev_R, frames_p - prev_p),
            rotation=np.einsum("nji,njk->nik", prev_R, frames_R),
            q_ref=model.qpos0[model.jnt_qposadr[ids]].copy(),
            q_home=np.array([home[name] for name in joints]),
            q_lower=np.where(limited, model.jnt_range[ids, 0], -np.inf),
            q_upper=np.where(limited, model.jnt_range[ids, 1], np.inf),
            tau_max=_torque_limits(model, joints, torque_limits),
            mass=mass,
            com=com,
            inertia=inertia,
            armature=model.dof_armature[model.jnt_dofadr[ids]].copy(),
            gravity=model.opt.gravity.copy(),
            site_offset=R_last.T @ (data.site_xpos[site_id] - frames_p[-1]),
            site_rotation=R_last.T @ data.site_xmat[site_id].reshape(3, 3),
            points=sample_control_points(
                model, data, capsules, bodies, frames_p, frames_R, spacing
            ),
            capsules=capsules.replace(pairs=touching_pairs(model, capsules)),
            hinge=tuple(
                bool(model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE) for j in ids
            ),
            joint_names=tuple(joints),
            site_name=site,
            body_names=tuple(dict.fromkeys(bodies)),
            mjcf=mjcf,
        )


def _frame_with_z(z: np.ndarray) -> np.ndarray:
    """Right-handed rotation whose third column is z."""
    helper = np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _segments(model: mujoco.MjModel, ids: Sequence[int]) -> np.ndarray:
    """Index of the last chain joint at or above each body; -1 for the fixed base."""
    segment = np.full(model.nbody, -1)
    for body in range(1, model.nbody):
        own = [k for k, j in enumerate(ids) if model.jnt_bodyid[j] == body]
        segment[body] = own[-1] if own else segment[model.body_parentid[body]]
    return segment


def _lumped_inertias(model, data, segment, frames_p, frames_R):
    """Mass, centre and inertia of the bodies that move with each joint."""
    n = len(frames_p)
    mass, com, inertia = np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3, 3))
    for k in range(n):
        bodies = np.flatnonzero(segment == k)
        m = model.body_mass[bodies]
        mass[k] = m.sum()
        centre = m @ data.xipos[bodies] / max(mass[k], 1e-12)
        if mass[k] <= 0:
            centre = frames_p[k]
        world = np.zeros((3, 3))
        for b in bodies:
            R = data.ximat[b].reshape(3, 3)
            r = data.xipos[b] - centre
            world += R @ np.diag(model.body_inertia[b]) @ R.T
            world += model.body_mass[b] * (r @ r * np.eye(3) - np.outer(r, r))
        com[k] = frames_R[k].T @ (centre - frames_p[k])
        inertia[k] = frames_R[k].T @ world @ frames_R[k]
    return mass, com, inertia


def _carriers(
    model: mujoco.MjModel, segment: np.ndarray, links: Sequence[str] | None
) -> set[int]:
    """Bodies whose geoms become capsules."""
    with_geoms = [b for b in range(1, model.nbody) if model.body_geomnum[b] > 0]
    names = {model.body(b).name: b for b in with_geoms}
    if links is None:
        return set(with_geoms)
    for link in links:
        if link not in names:
            raise RobotError(unknown("link with geoms", link, list(names)))
    return {names[link] for link in links}


def _torque_limits(
    model: mujoco.MjModel, joints: Sequence[str], given: Sequence[float] | None
) -> np.ndarray:
    """Largest torque each joint's single motor can give."""
    if given is not None:
        limits = np.asarray(given, float)
        if limits.shape != (len(joints),) or not np.all(limits > 0):
            raise RobotError(f"torque_limits must be {len(joints)} positive numbers")
        return limits
    limits = []
    for name in joints:
        joint = model.joint(name).id
        motors = [
            a
            for a in range(model.nu)
            if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
            and model.actuator_trnid[a, 0] == joint
        ]
        if len(motors) != 1:
            raise RobotError(
                f"joint '{name}' has {len(motors)} actuators: it needs one motor, "
                "or pass torque_limits="
            )
        limits.append(_motor_limit(model, motors[0], joint))
    return np.array(limits)


def _motor_limit(model: mujoco.MjModel, motor: int, joint: int) -> float:
    name = model.actuator(motor).name
    if model.actuator_biastype[motor] != mujoco.mjtBias.mjBIAS_NONE:
        raise RobotError(
            f"actuator '{name}' is not a motor (it has a bias): torque control needs "
            "<motor>, or pass torque_limits="
        )
    gear = abs(model.actuator_gear[motor, 0])
    candidates = []
    if model.actuator_ctrllimited[motor]:
        gain = model.actuator_gainprm[motor, 0]
        candidates.append(gain * gear * np.abs(model.actuator_ctrlrange[motor]).min())
    if model.actuator_forcelimited[motor]:
        candidates.append(gear * np.abs(model.actuator_forcerange[motor]).min())
    if model.jnt_actfrclimited[joint]:
        candidates.append(np.abs(model.jnt_actfrcrange[joint]).min())
    if not candidates:
        raise RobotError(
            f"actuator '{name}' has no ctrlrange or forcerange: give one, "
            "or pass torque_limits="
        )
    return float(min(candidates))
