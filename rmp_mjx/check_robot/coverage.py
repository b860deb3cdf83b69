"""How well the capsules fit the meshes: what sticks out, and what they add."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from rmp_mjx.robot import Robot
from rmp_mjx.robot.control_points import hull_corners
from rmp_mjx.robot.enclose import Capsule, distance_to_segment, hull_volume

SAMPLES = 2000
"""Points on the surface of each link's meshes."""


class LinkCoverage(NamedTuple):
    """One link of the arm."""

    body: str
    """Name of the body."""
    capsules: int
    """How many capsules it has."""
    ratio: float
    """Their volumes' sum over that of the hulls that they enclose; NaN: no meshes."""
    outside: float
    """Share of the meshes' surface outside of them."""
    farthest: float
    """The farthest point's distance from them [m]."""


def coverage(robot: Robot) -> list[LinkCoverage]:
    """Links with capsules, base first, and how these fit the meshes.

    A mesh that does not collide counts for the surface: it is what one sees.
    """
    model = robot.mj_model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    shells = world_capsules(robot, model, data)
    rng = np.random.default_rng(0)
    found = []
    for name in robot.body_names:
        body = model.body(name).id
        own = [capsule for geom, capsule in shells if model.geom_bodyid[geom] == body]
        geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body]
        meshes = [g for g in geoms if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH]
        fitted = {g for g, _ in shells} & set(meshes)
        hulls = sum(hull_volume(hull_corners(model, g)) for g in fitted)
        volume = sum(c.volume for g, c in shells if g in fitted)
        ratio = volume / hulls if hulls else np.nan
        if not meshes:
            found.append(LinkCoverage(name, len(own), ratio, 0.0, 0.0))
            continue
        points = np.concatenate([_surface(model, data, g, rng) for g in meshes])
        away = np.min(
            [distance_to_segment(points, c.start, c.end) - c.radius for c in own],
            axis=0,
        )
        outside = float(np.mean(away > 1e-6))
        farthest = max(float(away.max()), 0.0)
        found.append(LinkCoverage(name, len(own), ratio, outside, farthest))
    return found


def world_capsules(
    robot: Robot, model: mujoco.MjModel, data: mujoco.MjData
) -> list[tuple[int, Capsule]]:
    """The geom and the capsule, in the world, of every link capsule.

    Args:
        robot: The arm.
        model: Its model.
        data: Its state, of which the kinematics are known.
    """
    still = mujoco.MjData(model)
    mujoco.mj_kinematics(model, still)
    found = []
    for k, name in enumerate(robot.capsules.geom):
        geom = model.geom(name).id
        body, j = int(model.geom_bodyid[geom]), robot.capsules.segment[k]
        ends = (robot.capsules.start[k], robot.capsules.end[k])
        if j >= 0:  # from the joint's frame to the world, where the arm is at rest
            ends = [_frame(robot, j)[0] + _frame(robot, j)[1] @ x for x in ends]
        local = [
            still.xmat[body].reshape(3, 3).T @ (x - still.xpos[body]) for x in ends
        ]
        start, end = (
            data.xpos[body] + data.xmat[body].reshape(3, 3) @ x for x in local
        )
        found.append((geom, Capsule(start, end, float(robot.capsules.radius[k]))))
    return found


def _frame(robot: Robot, joint: int) -> tuple[np.ndarray, np.ndarray]:
    """Origin and rotation of a joint's frame in the reference pose."""
    p, R = np.zeros(3), np.eye(3)
    for j in range(joint + 1):
        p, R = p + R @ robot.offset[j], R @ robot.rotation[j]
    return p, R


def _surface(
    model: mujoco.MjModel, data: mujoco.MjData, geom: int, rng: np.random.Generator
) -> np.ndarray:
    """Even random points on a mesh in the world, (SAMPLES, 3) [m]."""
    mesh = model.geom_dataid[geom]
    first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    vertices = model.mesh_vert[model.mesh_vertadr[mesh] :].astype(float)
    corners = vertices[model.mesh_face[first : first + count]]
    a, b, c = np.moveaxis(corners, 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    pick = rng.choice(count, SAMPLES, p=area / area.sum())
    weights = rng.dirichlet(np.ones(3), SAMPLES)
    local = np.einsum("kij,ki->kj", corners[pick], weights)
    return data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T
