"""Pictures of an episode: the recorded states drawn by MuJoCo's renderer."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from envs.base import ArmEnv, State

SIZE = (480, 640)
"""Height and width of a frame [pixels]."""

_REACHED, _CURRENT, _LATER = (
    (0.15, 0.65, 0.3, 0.55),
    (0.1, 0.45, 0.95, 0.95),
    (0.1, 0.45, 0.95, 0.35),
)


def render(
    env: ArmEnv, states: Sequence[State], size: tuple[int, int] = SIZE
) -> list[np.ndarray]:
    """Draw recorded states, one frame each, via points included.

    Args:
        env: The environment that made them.
        states: States of one environment (not batched).
        size: Height and width [pixels].

    Returns:
        Frames (height, width, 3), uint8.
    """
    model = env.scene.model
    data = mujoco.MjData(model)
    frames = []
    with mujoco.Renderer(model, *size) as renderer:
        for state in states:
            data.qpos[:] = np.asarray(state.data.qpos)
            if model.nmocap:
                data.mocap_pos[:] = np.asarray(state.data.mocap_pos)
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera="front")
            if "points" in state.info:
                _draw_points(
                    renderer.scene,
                    np.asarray(state.info["points"]),
                    int(state.info["reached"]),
                )
            frames.append(renderer.render().copy())
    return frames


def _draw_points(scene: mujoco.MjvScene, points: np.ndarray, reached: int) -> None:
    """Add the via points as balls: reached, current, still to come."""
    for k, point in enumerate(points):
        color = _REACHED if k < reached else _CURRENT if k == reached else _LATER
        mujoco.mjv_initGeom(
            scene.geoms[scene.ngeom],
            mujoco.mjtGeom.mjGEOM_SPHERE,
            np.full(3, 0.018),
            point.astype(float),
            np.eye(3).ravel(),
            np.array(color, np.float32),
        )
        scene.ngeom += 1
