"""Reading an MJCF and reducing it to the serial chain that carries the site."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import mujoco

from rmp_mjx.names import unknown
from rmp_mjx.robot.errors import RobotError, warn
from rmp_mjx.robot.motors import drives


def read_spec(path: str | Path | mujoco.MjSpec) -> mujoco.MjSpec:
    """Parse an MJCF file or MJCF text, or copy a spec.

    Every body, joint and geom gets a name, and asset folders become absolute, so that
    the arm's text finds its meshes from anywhere.
    """
    spec = _parse(str(path)) if isinstance(path, (str, Path)) else path.copy()
    _make_assets_absolute(spec)
    for kind in ("body", "joint", "geom"):
        parts = {"body": spec.bodies, "joint": spec.joints, "geom": spec.geoms}[kind]
        taken = {part.name for part in parts}
        free = (f"{kind}_{k}" for k in itertools.count() if f"{kind}_{k}" not in taken)
        for part in parts:
            part.name = part.name or next(free)
    return spec


def _parse(text: str) -> mujoco.MjSpec:
    try:
        if text.lstrip().startswith("<"):
            return mujoco.MjSpec.from_string(text)
        if not Path(text).is_file():
            raise RobotError(f"no MJCF file at '{text}'")
        return mujoco.MjSpec.from_file(text)
    except ValueError as error:
        if isinstance(error, RobotError):
            raise
        raise RobotError(f"MuJoCo cannot read the MJCF: {error}") from error


def _make_assets_absolute(spec: mujoco.MjSpec) -> None:
    """Absolute folders for the spec's own files, absolute names for attached ones."""
    own = spec.compiler
    if spec.modelfiledir:
        folder = Path(spec.modelfiledir).resolve()
        own.meshdir = str(folder / own.meshdir)
        own.texturedir = str(folder / own.texturedir)
    for asset in (*spec.meshes, *spec.hfields, *spec.textures):
        texture = isinstance(asset, mujoco.MjsTexture)
        theirs = asset.compiler.texturedir if texture else asset.compiler.meshdir
        attached = theirs != (own.texturedir if texture else own.meshdir)
        file = Path(theirs) / asset.file
        if attached and file.is_absolute() and file.is_file():
            asset.file = str(file)


def model_name(spec: mujoco.MjSpec, path: str | Path | mujoco.MjSpec) -> str:
    """The model's name; without one the file's, or `arm`."""
    if spec.modelname != "MuJoCo Model":  # what MuJoCo calls a model without a name
        return spec.modelname
    if isinstance(path, (str, Path)) and not str(path).lstrip().startswith("<"):
        return Path(path).stem
    return "arm"


def lock_other_joints(
    spec: mujoco.MjSpec, site: str, joints: Sequence[str] | None
) -> list[str]:
    """Remove every joint (and its actuators) that is not on the chain to the site.

    Tendons, equalities, sensors and keyframes go with them: the arm is a chain and its
    actuators.

    Returns:
        The names of the chain's joints, base first.
    """
    chain, body = [], spec.site(site).parent
    while body.name != "world":
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
        moving = [body.name for body in spec.bodies if body.joints]
        raise RobotError(
            f"no joint between the world and site '{site}', which is on body "
            f"'{spec.site(site).parent.name}': choose a site or body that moves; "
            f"bodies with joints: {', '.join(moving) or 'none'}"
        )
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
        if not any(drives(actuator, name) for name in names):
            spec.delete(actuator)
    _warn_of_couplings(spec, names)
    # Grippers have these, and they may name a joint that goes.
    for part in (*spec.sensors, *spec.equalities, *spec.tendons, *spec.keys):
        spec.delete(part)
    for joint in list(spec.joints):
        if joint.name not in names:
            spec.delete(joint)
    return names


def _warn_of_couplings(spec: mujoco.MjSpec, joints: Sequence[str]) -> None:
    """Warn of mimic joints on the chain, which are free in the arm."""
    kind = mujoco.mjtEq.mjEQ_JOINT
    for equality in spec.equalities:
        mimic = {equality.name1, equality.name2} & set(joints)
        if equality.type == kind and mimic:
            warn(
                f"an equality couples joint {sorted(mimic)}: it is left out, so that "
                "every joint of the chain moves by itself"
            )


def remove_gravity_compensation(spec: mujoco.MjSpec) -> None:
    """Let the arm weigh what it weighs: the controllers carry it themselves."""
    floating = [body for body in spec.bodies if body.gravcomp]
    for body in floating:
        body.gravcomp = 0.0
    if floating:
        warn(
            f"bodies {[body.name for body in floating]} have gravcomp, which is left "
            "out: the controllers carry the arm's weight themselves"
        )


def home_configuration(spec: mujoco.MjSpec) -> dict[str, float] | None:
    """Each joint's coordinate in keyframe `home`, if the file has it."""
    model = compile_spec(spec)
    for k in range(model.nkey):
        if model.key(k).name == "home":
            return {
                model.joint(j).name: float(model.key_qpos[k, model.jnt_qposadr[j]])
                for j in range(model.njnt)
            }
    return None


def compile_spec(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile, with MuJoCo's complaint as a `RobotError`."""
    try:
        return spec.compile()
    except ValueError as error:
        raise RobotError(f"MuJoCo cannot compile the MJCF: {error}") from error


def compile_text(
    spec: mujoco.MjSpec,
) -> tuple[mujoco.MjModel, str, tuple[tuple[str, bytes], ...]]:
    """The arm as MJCF text, and the model compiled from this very text.

    MuJoCo writes numbers with six digits: compiled from the text, both are the same
    arm.

    Returns:
        The model, its text, and the assets that exist in memory only, by file name.

    Raises:
        RobotError: MuJoCo cannot compile the arm, or cannot find its files.
    """
    compile_spec(spec)
    text = spec.to_xml()
    assets = dict(spec.assets)
    try:
        model = mujoco.MjSpec.from_string(text, assets=assets).compile()
    except ValueError as error:
        raise RobotError(
            f"MuJoCo cannot compile the arm's own text: {error}. If a file is missing, "
            "give each spec an absolute compiler.meshdir before you attach it"
        ) from error
    return model, text, tuple(sorted(assets.items()))
