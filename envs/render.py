"""Pictures of an episode: the recorded states drawn by MuJoCo's renderer."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import mujoco
import numpy as np

from envs.base import ArmEnv
from envs.scene import TABLE_HEIGHT
from envs.types import State

SIZE = (480, 640)
"""Height and width of a frame [pixels]."""

SHADOW_PIXELS = 1024
"""Side of the shadow map. Four times as large, a frame takes three times as long."""

FRONT = {"lookat": (0.25, 0.0, 0.2), "distance": 1.4, "azimuth": 143, "elevation": -22}
"""The usual view: from beyond the workspace, at the arm's right [m, degrees]."""

VIEWS = {
    "door": {
        "lookat": (0.4, 0.02, 0.14),
        "distance": 1.45,
        "azimuth": -65,
        "elevation": -26,
    }
}
"""Views of the tasks that are seen from elsewhere: the panel would hide the hand."""

_REACHED, _CURRENT, _LATER = (
    (0.15, 0.65, 0.3, 0.55),
    (0.1, 0.45, 0.95, 0.95),
    (0.1, 0.45, 0.95, 0.35),
)
_GOAL, _DISC = (0.15, 0.65, 0.3, 0.6), np.array([0.05, 0.001, 0.0])


def render(
    env: ArmEnv,
    states: Sequence[State],
    size: tuple[int, int] = SIZE,
    shadows: bool = True,
) -> list[np.ndarray]:
    """Draw recorded states, one frame each, via points and goals included.

    Args:
        env: The environment that made them.
        states: States of one environment (not batched).
        size: Height and width [pixels].
        shadows: Whether to draw shadows, which takes half of the time.

    Returns:
        Frames (height, width, 3), uint8.
    """
    model = copy.copy(env.scene.model)
    model.vis.quality.shadowsize = SHADOW_PIXELS
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    view = VIEWS.get(env.name, FRONT)
    camera.lookat[:] = view["lookat"]
    camera.distance = view["distance"]
    camera.azimuth, camera.elevation = view["azimuth"], view["elevation"]
    frames = []
    with mujoco.Renderer(model, *size) as renderer:
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        for state in states:
            data.qpos[:] = np.asarray(state.data.qpos)
            if model.nmocap:
                data.mocap_pos[:] = np.asarray(state.data.mocap_pos)
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            _draw_marks(renderer.scene, state.info)
            frames.append(renderer.render().copy())
    return frames


def _draw_marks(scene: mujoco.MjvScene, info: dict) -> None:
    """Add the goals of the policy: via points as balls, a goal as a disc."""
    if "points" in info:
        reached = int(info["reached"])
        for k, point in enumerate(np.asarray(info["points"], float)):
            color = _REACHED if k < reached else _CURRENT if k == reached else _LATER
            _add(scene, mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, 0.018), point, color)
    if "goal" in info:
        x, y = np.asarray(info["goal"], float)[:2]
        place = np.array([x, y, TABLE_HEIGHT])
        _add(scene, mujoco.mjtGeom.mjGEOM_CYLINDER, _DISC, place, _GOAL)


def _add(
    scene: mujoco.MjvScene,
    kind: mujoco.mjtGeom,
    size: np.ndarray,
    place: np.ndarray,
    color: tuple[float, float, float, float],
) -> None:
    mujoco.mjv_initGeom(
        scene.geoms[scene.ngeom],
        kind,
        size,
        place,
        np.eye(3).ravel(),
        np.array(color, np.float32),
    )
    scene.ngeom += 1
