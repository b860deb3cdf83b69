"""Pictures of an episode: the recorded states drawn by MuJoCo's renderer."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import mujoco
import numpy as np

from .base import ArmEnv
from .task import Mark
from .types import State

SIZE = (480, 640)
"""Height and width of a frame [pixels]."""

SHADOW_PIXELS = 1024
"""Side of the shadow map. Four times as large, a frame takes three times as long."""

_SHAPES = {
    "ball": (mujoco.mjtGeom.mjGEOM_SPHERE, 0.0),
    "disc": (mujoco.mjtGeom.mjGEOM_CYLINDER, 0.001),
}
"""MuJoCo's geom of a mark's shape, and half its height [m]."""


def render(
    env: ArmEnv,
    states: Sequence[State],
    size: tuple[int, int] = SIZE,
    shadows: bool = True,
) -> list[np.ndarray]:
    """Draw recorded states, one frame each, with the task's marks.

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
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = env.view
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
            for mark in env.marks(state):
                _add(renderer.scene, mark)
            frames.append(renderer.render().copy())
    return frames


def _add(scene: mujoco.MjvScene, mark: Mark) -> None:
    """Add a mark to what is drawn."""
    kind, half_height = _SHAPES[mark.shape]
    mujoco.mjv_initGeom(
        scene.geoms[scene.ngeom],
        kind,
        np.array([mark.radius, half_height or mark.radius, mark.radius]),
        mark.place,
        np.eye(3).ravel(),
        np.array(mark.color, np.float32),
    )
    scene.ngeom += 1
