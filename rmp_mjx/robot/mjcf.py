"""Reading an MJCF and reducing it to the serial chain that carries the site."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import mujoco

from rmp_mjx.names import unknown


class RobotError(ValueError):
    """The MJCF, or a name given with it, cannot serve as a robot."""


def read_spec(path: str | Path) -> mujoco.MjSpec:
    """Parse an MJCF file, or MJCF text; every body, joint and geom gets a name."""
    text = str(path)
    try:
        if text.lstrip().startswith("<"):
            spec = mujoco.MjSpec.from_string(text)
        elif not Path(text).is_file():
            raise RobotError(f"no MJCF file at '{text}'")
        else:
            spec = mujoco.MjSpec.from_file(text)
            folder = Path(text).resolve().parent  # the arm's text must find its assets
            spec.compiler.meshdir = str(folder / spec.compiler.meshdir)
            spec.compiler.texturedir = str(folder / spec.compiler.texturedir)
    except ValueError as error:
        if isinstance(error, RobotError):
            raise
        raise RobotError(f"MuJoCo cannot read the MJCF: {error}") from error
    for kind in ("body", "joint", "geom"):
        parts = {"body": spec.bodies, "joint": spec.joints, "geom": spec.geoms}[kind]
        taken = {part.name for part in parts}
        free = (f"{kind}_{k}" for k in itertools.count() if f"{kind}_{k}" not in taken)
        for part in parts:
            part.name = part.name or next(free)
    return spec


def lock_other_joints(
    spec: mujoco.MjSpec, site: str, joints: Sequence[str] | None
) -> tuple[mujoco.MjSpec, list[str]]:
    """Remove every joint (and its actuators) that is not on the chain to the site.

    Tendons, equalities and sensors go with them: the arm is a chain and its motors.
    """
    sites = {s.name: s for s in spec.sites}
    if site not in sites:
        raise RobotError(unknown("site", site, sorted(sites)))
    chain, body = [], sites[site].parent
    while body is not None and body.name != "world":
        chain = [*body.joints, *chain]
        body = body.parent
    for joint in chain:
        if joint.type not in (
            mujoco.mjtJoint.mjJNT_HINGE,
            mujoco.mjtJoint.mjJNT_SLIDE,
        ):
            kind = mujoco.mjtJoint(joint.type).name
            raise RobotError(f"joint '{joint.name}' is {kind}: use hinges and slides")
    names = [joint.name for joint in chain]
    if not names:
        raise RobotError(f"no joint between the world and site '{site}'")
    if joints is not None:
        for name in joints:
            if name not in names:
                raise RobotError(
                    unknown(f"joint on the chain to '{site}'", name, names)
                )
        if list(joints) != names:
            raise RobotError(
                f"the chain to '{site}' has the joints {names}; got {list(joints)}: "
                "give all of them, base first"
            )
    for actuator in list(spec.actuators):
        on_joint = actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT
        if not on_joint or actuator.target not in names:
            spec.delete(actuator)
    for part in (*spec.sensors, *spec.equalities, *spec.tendons):
        spec.delete(part)  # grippers have them, and they may name a joint that goes
    for joint in list(spec.joints):
        if joint.name not in names:
            spec.delete(joint)
    return spec, names


def home_configuration(
    spec: mujoco.MjSpec,
) -> dict[str, float]:
    """Each joint's coordinate in keyframe `home`, else at the reference pose."""
    model = compile_spec(spec)
    qpos = model.qpos0
    for k in range(model.nkey):
        if model.key(k).name == "home":
            qpos = model.key_qpos[k]
    return {
        model.joint(j).name: float(qpos[model.jnt_qposadr[j]])
        for j in range(model.njnt)
    }


def compile_spec(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile, with MuJoCo's complaint as a `RobotError`."""
    try:
        return spec.compile()
    except ValueError as error:
        raise RobotError(f"MuJoCo cannot compile the MJCF: {error}") from error


def compile_text(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, str]:
    """The arm as MJCF text, and the model compiled from this very text.

    MuJoCo writes numbers with six digits: compiled from the text, both are the same
    arm. Keyframes are left out.
    """
    for key in list(spec.keys):
        spec.delete(key)
    compile_spec(spec)
    text = spec.to_xml()
    return mujoco.MjModel.from_xml_string(text), text
