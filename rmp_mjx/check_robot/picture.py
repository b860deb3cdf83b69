"""A picture of the arm with its capsules and control points, from two sides."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from rmp_mjx import runtime
from rmp_mjx.check_robot.coverage import world_capsules
from rmp_mjx.robot import Robot

SIZE = (640, 560)
"""Height and width of each view [pixels]."""

SIDES = (90.0, 180.0)
"""Azimuths of the two views [degrees]."""

_GLASS = 0.6
"""Opacity of the arm, so that the control points inside show."""

_SHELL = np.array([0.2, 0.5, 1.0, 0.25], np.float32)
_POINT = np.array([0.9, 0.3, 0.1, 1.0], np.float32)


def draw(robot: Robot, path: Path) -> str | None:
    """Write the picture of the arm in its home posture; returns why not, if not."""
    if runtime.choose_gl() is None:
        return "no headless rendering here (neither EGL nor OSMesa)"
    try:
        import mediapy

        mediapy.write_image(path, views(robot))
    except Exception as error:  # graphics stacks fail in many ways; numbers are safe
        return " ".join(str(error).split())[:160] or type(error).__name__
    return None


def views(robot: Robot, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Both views side by side, (height, 2 width, 3) uint8."""
    spec = robot.mj_spec
    spec.visual.global_.offheight, spec.visual.global_.offwidth = size
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.5] * 3, [0.5] * 3
    spec.add_texture(
        name="check/sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[1.0] * 3,
        width=8,
        height=8,
    )
    model = spec.compile()
    model.geom_rgba[_hidden(model), 3] = 0.0
    data = mujoco.MjData(model)
    for name, value in zip(robot.joint_names, robot.q_home, strict=True):
        data.joint(name).qpos[0] = value
    mujoco.mj_forward(model, data)
    camera, shots = mujoco.MjvCamera(), []
    centre = np.array([c.start for _, c in world_capsules(robot, model, data)])
    low, high = centre.min(0), centre.max(0)
    camera.lookat[:] = (low + high) / 2
    camera.distance = 1.5 * float(np.linalg.norm(high - low))
    camera.elevation = -15.0
    with mujoco.Renderer(model, *size) as renderer:
        for camera.azimuth in SIDES:
            renderer.update_scene(data, camera)
            for geom in renderer.scene.geoms[: renderer.scene.ngeom]:
                geom.rgba[3] *= _GLASS
            for _, capsule in world_capsules(robot, model, data):
                _add_capsule(renderer.scene, *capsule)
            for body, offset, _ in robot.control_points:
                pose = data.body(body)
                x = pose.xpos + pose.xmat.reshape(3, 3) @ offset
                _add_capsule(renderer.scene, x, x, 0.006, _POINT)
            shots.append(renderer.render().copy())
    return np.concatenate(shots, axis=1)


def _hidden(model: mujoco.MjModel) -> np.ndarray:
    """Geoms that collide, on bodies that have others to look at."""
    collides = (model.geom_contype | model.geom_conaffinity) != 0
    seen = set(model.geom_bodyid[~collides])
    return collides & np.isin(model.geom_bodyid, list(seen))


def _add_capsule(
    scene: mujoco.MjvScene,
    start: np.ndarray,
    end: np.ndarray,
    radius: float,
    color: np.ndarray = _SHELL,
) -> None:
    """Draw a capsule, or a sphere where both ends are one."""
    geom = scene.geoms[scene.ngeom]
    kind = mujoco.mjtGeom.mjGEOM_CAPSULE
    if np.linalg.norm(end - start) < 1e-6:
        kind = mujoco.mjtGeom.mjGEOM_SPHERE
    mujoco.mjv_initGeom(geom, kind, np.full(3, radius), start, np.eye(3).ravel(), color)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        mujoco.mjv_connector(geom, kind, radius, start, end)
    scene.ngeom += 1
