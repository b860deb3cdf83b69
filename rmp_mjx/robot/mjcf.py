"""Reading an MJCF and reducing it to the serial chain that carries the site."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np


class RobotError(ValueError):
    """The MJCF, or a name given with it, cannot serve as a robot."""


def unknown(kind: str, name: str, valid: Sequence[str]) -> str:
    """Message for a name that does not exist, with those that do."""
    near = difflib.get_close_matches(name, valid, n=1)
    hint = f" Did you mean '{near[0]}'?" if near else ""
    return f"unknown {kind} '{name}'; valid names: {', '.join(valid)}.{hint}"


def read_spec(path: str | Path) -> mujoco.MjSpec:
    """Parse an MJCF file, or MJCF text."""
    text = str(path)
    try:
        if text.lstrip().startswith("<"):
            return mujoco.MjSpec.from_string(text)
        if not Path(text).is_file():
            raise RobotError(f"no MJCF file at '{text}'")
        spec = mujoco.MjSpec.from_file(text)
        folder = Path(text).resolve().parent  # so that the arm's text finds its assets
        spec.compiler.meshdir = str(folder / spec.compiler.meshdir)
        spec.compiler.texturedir = str(folder / spec.compiler.texturedir)
        return spec
    except ValueError as error:
        if isinstance(error, RobotError):
            raise
        raise RobotError(f"MuJoCo cannot read the MJCF: {error}") from error


def lock_other_joints(
    spec: mujoco.MjSpec, site: str, joints: Sequence[str] | None
) -> tuple[mujoco.MjSpec, list[str]]:
    """Remove every joint (and its actuators) that is not on the chain to the site."""
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
        if (
            actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT
            and actuator.target not in names
        ):
            spec.delete(actuator)
    for joint in list(spec.joints):
        if joint.name not in names:
            spec.delete(joint)
    for key in list(spec.keys):
        if len(key.qpos) != len(names):
            spec.delete(key)
    return spec, names


def compile_arm(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, str, np.ndarray]:
    """The compiled arm, its MJCF text and its home configuration (nq,).

    MuJoCo writes numbers with six digits, so the model is compiled from the text: they
    are the same arm to the last bit.
    """
    try:
        home = _home(spec.compile())
    except ValueError as error:
        raise RobotError(f"MuJoCo cannot compile the MJCF: {error}") from error
    for key in list(spec.keys):  # home is all that matters of them
        spec.delete(key)
    text = spec.to_xml()
    return mujoco.MjModel.from_xml_string(text), text, home


def _home(model: mujoco.MjModel) -> np.ndarray:
    """Keyframe `home`, else the reference configuration."""
    for k in range(model.nkey):
        if model.key(k).name == "home":
            return model.key_qpos[k].copy()
    return model.qpos0.copy()
