"""From an MJCF with a serial chain to the arrays that the controller needs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from flax import struct
from jaxtyping import Float

from rmp_mjx.names import unknown
from rmp_mjx.pytree import Pytree
from rmp_mjx.refuse import refuse_crossed
from rmp_mjx.robot.configurations import touching_pairs
from rmp_mjx.robot.control_points import (
    Capsules,
    ControlPoints,
    body_capsules,
    sample_control_points,
)
from rmp_mjx.robot.end_effector import end_effector
from rmp_mjx.robot.errors import Numbers, RobotError, vector, warn
from rmp_mjx.robot.fingerprint import fingerprint
from rmp_mjx.robot.library import find
from rmp_mjx.robot.limits import rated, urdf_velocities
from rmp_mjx.robot.links import carriers, frame_with_z, lumped_inertias, segments
from rmp_mjx.robot.mjcf import (
    compile_spec,
    compile_text,
    home_configuration,
    lock_other_joints,
    model_name,
    read_spec,
    remove_gravity_compensation,
)
from rmp_mjx.robot.motors import PassiveForces, make_motors, passive_forces
from rmp_mjx.robot.mounting import add_finger, stand_at
from rmp_mjx.robot.posture import nominal_posture, search_posture
from rmp_mjx.types import Constant

ARMATURE = {
    "physical": None,
    "robosuite": [5.0 / (i + 1) for i in range(7)],
}
"""Rotor inertias of the Jaco 2 [kg m^2]: the file's own, or robosuite's 5/(i+1)."""

SPACING = 0.0135
"""Default distance between control points [m]: 59 of them on the Jaco 2."""


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
    """Nominal posture, within the joint limits."""
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
    """The arm-only model as MJCF text: the chain, and one torque motor per joint."""
    name: str = struct.field(pytree_node=False, default="arm")
    """The MJCF model's name."""
    assets: tuple[tuple[str, bytes], ...] = struct.field(pytree_node=False, default=())
    """Meshes and textures that exist in memory only: (file name, content)."""
    qd_max: Float[Constant, " n"] | None = None
    """Limits of the joint speeds [rad/s or m/s]; None for none."""
    tau_rate_max: Float[Constant, " n"] | None = None
    """Limits of the torques' rates [N m/s or N/s]; None for none."""
    damping: Float[Constant, " n"] | None = None
    """Viscous damping that the controllers compensate; None for none
    [N m s/rad or N s/m]."""
    stiffness: Float[Constant, " n"] | None = None
    """Stiffness of the joint springs that they compensate; None for none
    [N m/rad or N/m]."""
    spring_ref: Float[Constant, " n"] | None = None
    """Joint coordinates at which those springs are slack [rad or m]."""

    def __post_init__(self):
        """Check the joint limits.

        Raises:
            ValueError: A lower limit is above the upper one.
        """
        refuse_crossed(self.q_lower, self.q_upper, ("q_lower", "q_upper"))

    def __repr__(self) -> str:
        """Name, joints, end effector and control points on one line."""
        return (
            f"Robot('{self.name}', {self.n} joints to site '{self.site_name}', "
            f"{len(self.points.segment)} control points)"
        )

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def mj_model(self) -> mujoco.MjModel:
        """The arm-only model, compiled by MuJoCo C (a new copy each time)."""
        return self.mj_spec.compile()

    @property
    def mj_spec(self) -> mujoco.MjSpec:
        """The arm-only model to edit or to attach to a scene (a new copy each time)."""
        return mujoco.MjSpec.from_string(self.mjcf, assets=dict(self.assets))

    @property
    def friction(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Friction of the joints in the MJCF, whether the controllers compensate it.

        Viscous damping, (n,) [N m s/rad or N s/m], and dry friction, (n,) [N m or N].
        """
        model = self.mj_model
        dofs = [int(model.joint(name).dofadr[0]) for name in self.joint_names]
        return model.dof_damping[dofs], model.dof_frictionloss[dofs]

    @property
    def fingerprint(self) -> str:
        """32 hex digits that say which arm this is; see `fingerprint.fingerprint`."""
        return fingerprint(self)

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
    def load(
        name: str = "jaco2", armature: str | Numbers = "physical", **kwargs: Any
    ) -> Robot:
        """Load an arm by its name, or from a file.

        Args:
            name: One of `rmp_mjx.robots`, a path of an MJCF, or a path of a file of
                parameters (`.toml`), which `python -m rmp_mjx.check_robot` writes.
            armature: Rotor inertias: `physical` for the file's own, or numbers that
                replace them, (n,) [kg m^2]. The Jaco 2 has `robosuite`, too, which adds
                5/(i+1) kg m^2 to joint i and so dominates the arm's inertia.
            **kwargs: Passed to `from_mjcf` (for instance `spacing`), over what the name
                or the file of parameters says.

        Raises:
            RobotError: Unknown name or armature setting; and what `from_mjcf` raises.
        """
        path, options = find(name)
        rotors: dict[str, Any] = {"armature": armature}
        if isinstance(armature, str):
            if armature not in ARMATURE:
                raise RobotError(unknown("armature setting", armature, list(ARMATURE)))
            replaced = ARMATURE[armature]
            rotors = {} if replaced is None else {"armature": replaced}
        if "site" in kwargs or "body" in kwargs:
            options = {k: v for k, v in options.items() if k not in ("site", "body")}
        return Robot.from_mjcf(path, **options | rotors | kwargs)

    @staticmethod
    def from_mjcf(
        path: str | Path | mujoco.MjSpec,
        site: str | None = None,
        joints: Sequence[str] | None = None,
        links: Sequence[str] | None = None,
        *,
        body: str | None = None,
        offset: Numbers = (0.0, 0.0, 0.0),
        mount: Numbers = (0.0, 0.0, 0.0),
        finger: float | None = None,
        armature: Numbers | None = None,
        torque_limits: Numbers | None = None,
        velocity_limits: Numbers | None = None,
        torque_rate_limits: Numbers | None = None,
        q_home: Numbers | None = None,
        compensate_passive: bool = True,
        spacing: float = SPACING,
    ) -> Robot:
        """Build a robot from any MJCF with a serial chain of hinge or slide joints.

        Joints that are not on the chain from the world to the end effector (fingers,
        say) are locked at their reference position. The chain's actuators, of whatever
        kind, become torque motors in `mjcf`, `mj_model` and every scene made of them.

        Args:
            path: MJCF file, MJCF text, or a spec, which is copied.
            site: End-effector site; the chain runs from the world to its body.
            joints: The chain's joints, base first; default all of them.
            links: Bodies that carry control points; default all with geoms.
            body: Body of the end effector, instead of a site.
            offset: End effector's position in that body's frame, (3,) [m].
            mount: Where the file's origin stands in the world, (3,) [m].
            finger: Put a rigid finger of 15 cm at the end effector, along its z axis,
                and move the end effector to its tip, turned about the finger by this
                angle [rad]. None: no finger.
            armature: Rotor inertias that replace the file's, (n,) [kg m^2].
            torque_limits: Actuator limits that replace the file's, (n,) [N m or N].
            velocity_limits: Limits of the joint speeds, (n,) [rad/s or m/s]; default
                a URDF's own, the custom numbers of this name in an MJCF, else none.
            torque_rate_limits: Limits of the torques' rates, (n,) [N m/s or N/s];
                likewise.
            q_home: Nominal posture, (n,) [rad or m]; default keyframe `home`, else the
                reference pose, or a searched one where that is near the end of a
                joint's range, singular, or in collision with itself.
            compensate_passive: Whether the controllers make up for the file's joint
                damping and springs.
            spacing: Distance between control points along a link's capsules [m].

        Raises:
            RobotError: A name is unknown, the chain has a joint that is neither hinge
                nor slide, a joint has not exactly one actuator with a torque limit, or
                the posture is outside the joint ranges.

        Warns:
            RobotWarning: The file has dry friction or something else that the
                controllers cannot compensate, or the posture had to be chosen.
        """
        spec = read_spec(path)
        site = end_effector(spec, site, body, offset)
        stand_at(spec, mount)
        if finger is not None:
            site = add_finger(spec, site, finger)
        home = home_configuration(spec)
        joints = lock_other_joints(spec, site, joints)
        remove_gravity_compensation(spec)
        make_motors(spec, compile_spec(spec), joints, torque_limits)
        if armature is not None:
            rotors = vector("armature", armature, len(joints))
            for name, value in zip(joints, rotors, strict=True):
                spec.joint(name).armature = value
        model, mjcf, assets = compile_text(spec)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        ids = [model.joint(name).id for name in joints]
        frames_p = np.array([data.xanchor[j] for j in ids])
        frames_R = np.array([frame_with_z(data.xaxis[j]) for j in ids])
        segment = segments(model, ids)
        mass, com, inertia = lumped_inertias(model, data, segment, frames_p, frames_R)
        capsules, bodies = body_capsules(
            model, data, segment, frames_p, frames_R, carriers(model, segment, links)
        )
        limited = model.jnt_limited[ids].astype(bool)
        lower = np.where(limited, model.jnt_range[ids, 0], -np.inf)
        upper = np.where(limited, model.jnt_range[ids, 1], np.inf)
        q_ref = model.qpos0[model.jnt_qposadr[ids]].copy()
        if velocity_limits is None:
            velocity_limits = urdf_velocities(path, joints)
        posture = nominal_posture(joints, lower, upper, home, q_home)
        passive = passive_forces(model, joints)
        if not compensate_passive:
            passive = PassiveForces()
        site_id = model.site(site).id
        R_last = frames_R[-1]
        prev_p = np.vstack([np.zeros(3), frames_p[:-1]])
        prev_R = np.concatenate([np.eye(3)[None], frames_R[:-1]])
        robot = Robot(
            offset=np.einsum("nji,nj->ni", prev_R, frames_p - prev_p),
            rotation=np.einsum("nji,njk->nik", prev_R, frames_R),
            q_ref=q_ref,
            q_home=q_ref if posture is None else posture,
            q_lower=lower,
            q_upper=upper,
            tau_max=model.actuator_ctrlrange[:, 1].copy(),
            qd_max=rated(model, "velocity_limits", velocity_limits, len(joints)),
            tau_rate_max=rated(
                model, "torque_rate_limits", torque_rate_limits, len(joints)
            ),
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
            capsules=capsules,
            hinge=tuple(
                bool(model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE) for j in ids
            ),
            joint_names=tuple(joints),
            site_name=site,
            body_names=tuple(dict.fromkeys(bodies)),
            mjcf=mjcf,
            name=model_name(spec, path),
            assets=assets,
            **passive._asdict(),
        )
        robot = robot.replace(capsules=capsules.replace(pairs=touching_pairs(robot)))
        if posture is None:
            robot = robot.replace(q_home=_searched(robot))
        return robot


def _searched(robot: Robot) -> np.ndarray:
    """The posture of an arm whose file has none; warns if it had to be chosen."""
    posture, fault = search_posture(robot)
    if fault:
        shown = ", ".join(f"{x:.2f}" for x in posture)
        warn(
            f"there is no keyframe 'home', and the reference pose {fault}: q_home is "
            f"[{shown}], which was searched. Pass q_home= to choose a posture"
        )
    return posture
