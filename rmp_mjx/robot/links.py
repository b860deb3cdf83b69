"""Which bodies move with which joint, and what they weigh together."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from rmp_mjx.names import unknown
from rmp_mjx.robot.errors import RobotError


def frame_with_z(z: np.ndarray) -> np.ndarray:
    """Right-handed rotation whose third column is z."""
    helper = np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def segments(model: mujoco.MjModel, ids: Sequence[int]) -> np.ndarray:
    """Index of the last chain joint at or above each body; -1 for the fixed base."""
    segment = np.full(model.nbody, -1)
    for body in range(model.nbody):  # the world is its own parent
        own = [k for k, j in enumerate(ids) if model.jnt_bodyid[j] == body]
        segment[body] = own[-1] if own else segment[model.body_parentid[body]]
    return segment


def lumped_inertias(model, data, segment, frames_p, frames_R):
    """Mass, centre and inertia of the bodies that move with each joint."""
    n = len(frames_p)
    mass, com, inertia = np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3, 3))
    for k in range(n):
        bodies = np.flatnonzero(segment == k)
        m = model.body_mass[bodies]
        mass[k] = m.sum()
        centre = m @ data.xipos[bodies] / mass[k] if mass[k] else frames_p[k]
        world = np.zeros((3, 3))
        for b in bodies:
            R = data.ximat[b].reshape(3, 3)
            r = data.xipos[b] - centre
            world += R @ np.diag(model.body_inertia[b]) @ R.T
            world += model.body_mass[b] * (r @ r * np.eye(3) - np.outer(r, r))
        com[k] = frames_R[k].T @ (centre - frames_p[k])
        inertia[k] = frames_R[k].T @ world @ frames_R[k]
    return mass, com, inertia


def carriers(
    model: mujoco.MjModel, segment: np.ndarray, links: Sequence[str] | None
) -> set[int]:
    """Bodies whose geoms become capsules."""
    with_geoms = [b for b in range(1, model.nbody) if model.body_geomnum[b]]
    names = {model.body(b).name: b for b in with_geoms}
    if links is None:
        return set(with_geoms)
    for link in links:
        if link not in names:
            raise RobotError(unknown("link with geoms", link, list(names)))
    return {names[link] for link in links}
