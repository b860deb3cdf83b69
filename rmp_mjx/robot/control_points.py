"""Capsules around the links, and control points sampled along them."""

from __future__ import annotations

import mujoco
import numpy as np
from flax import struct
from jaxtyping import Float

from rmp_mjx.pytree import Pytree
from rmp_mjx.robot.enclose import Capsule, enclosing_capsules
from rmp_mjx.robot.errors import warn
from rmp_mjx.types import Constant


class Capsules(Pytree):
    """Link capsules in the frames of the joints that move them."""

    start: Float[Constant, "c 3"]
    """One end of the axis [m]; world frame for the fixed base."""
    end: Float[Constant, "c 3"]
    """The other end [m]."""
    radius: Float[Constant, " c"]
    """Radius [m]."""
    segment: tuple[int, ...] = struct.field(pytree_node=False)
    """Joint that moves the capsule; -1 for the fixed base."""
    geom: tuple[str, ...] = struct.field(pytree_node=False)
    """Name of the MJCF geom it encloses."""
    pairs: tuple[tuple[int, int], ...] = struct.field(pytree_node=False, default=())
    """Capsule pairs (far, near) that self-collision watches."""


class ControlPoints(Pytree):
    """Spheres inscribed in the link capsules."""

    offset: Float[Constant, "p 3"]
    """Centre in the joint frame [m]."""
    radius: Float[Constant, " p"]
    """Radius [m]."""
    body_offset: Float[Constant, "p 3"]
    """Centre in the MJCF body's frame [m]."""
    segment: tuple[int, ...] = struct.field(pytree_node=False)
    """Joint that moves the point."""
    body: tuple[str, ...] = struct.field(pytree_node=False)
    """Name of the MJCF body that carries it."""

    @property
    def hand(self) -> np.ndarray:
        """Which of them the last joint moves, (p,) bool."""
        segment = np.array(self.segment, int)
        return segment == segment.max(initial=0)


def body_capsules(model, data, segment, frames_p, frames_R, carriers):
    """Enclose every colliding geom of the carrier bodies in capsules.

    Capsules and spheres are taken as they are. Capsules are fitted to the hull of any
    other geom, see `enclose`. Where no geom of a moving link collides, all geoms count,
    with a warning.

    Returns:
        The capsules, and the body name of each.
    """
    starts, ends, radii, segments, geoms, bodies = [], [], [], [], [], []
    collide = (model.geom_contype | model.geom_conaffinity).astype(bool)
    if not np.any(collide & (segment[model.geom_bodyid] >= 0)):
        warn(
            "no geom of a moving link collides (contype and conaffinity are 0): all "
            "geoms become capsules"
        )
        collide[:] = True
    for geom in map(int, np.flatnonzero(collide)):
        body = int(model.geom_bodyid[geom])
        if body not in carriers:
            continue
        k = int(segment[body])
        for start, end, radius in _capsules_of(model, data, geom):
            if k >= 0:
                start, end = ((x - frames_p[k]) @ frames_R[k] for x in (start, end))
            starts.append(start)
            ends.append(end)
            radii.append(radius)
            segments.append(k)
            geoms.append(model.geom(geom).name)
            bodies.append(model.body(body).name)
    capsules = Capsules(
        start=np.reshape(starts, (len(starts), 3)),
        end=np.reshape(ends, (len(ends), 3)),
        radius=np.array(radii, float),
        segment=tuple(segments),
        geom=tuple(geoms),
    )
    return capsules, bodies


def _capsules_of(model, data, geom) -> list[Capsule]:
    """Capsules in the world that enclose a geom."""
    centre, R = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
    size, kind = model.geom_size[geom], model.geom_type[geom]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return [Capsule(centre, centre, size[0])]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        axis = R[:, 2] * size[1]
        return [Capsule(centre - axis, centre + axis, size[0])]
    return [
        Capsule(centre + R @ start, centre + R @ end, radius)
        for start, end, radius in enclosing_capsules(hull_corners(model, geom))
    ]


_RIM = 32
"""Corners of the polygon round a cylinder's rim."""


def hull_corners(model: mujoco.MjModel, geom: int) -> Float[np.ndarray, "k 3"]:
    """Points whose hull contains a geom, in the geom's frame [m].

    They are a mesh's vertices, the corners of polygons round a cylinder's rims, and the
    corners of the bounding box of anything else.
    """
    kind = model.geom_type[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        return model.mesh_vert[first : first + count].astype(float)
    signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        radius, half = model.geom_size[geom, :2]
        angle = 2.0 * np.pi * np.arange(_RIM) / _RIM
        rim = np.stack([np.cos(angle), np.sin(angle)], 1) * radius
        rim /= np.cos(np.pi / _RIM)  # round the circle
        return np.concatenate(
            [np.column_stack([rim, np.full(_RIM, z)]) for z in (-half, half)]
        )
    centre, half = np.split(model.geom_aabb[geom], 2)
    return centre + signs * half


def sample_control_points(
    model, data, capsules: Capsules, bodies, frames_p, frames_R, spacing: float
) -> ControlPoints:
    """Place points along each moving capsule's axis, ends included, evenly.

    Points of one capsule are at most `spacing` apart, so that the spheres around
    them cover the capsule up to a scallop of spacing^2 / (8 radius).
    """
    if not spacing > 0:
        raise ValueError(f"spacing must be positive, got {spacing}")
    offset, radius, body_offset, segment, body = [], [], [], [], []
    for c, k in enumerate(capsules.segment):
        if k < 0:
            continue
        start, end = capsules.start[c], capsules.end[c]
        count = int(np.ceil(np.linalg.norm(end - start) / spacing - 1e-9)) + 1
        b = model.body(bodies[c]).id
        for s in np.linspace(0.0, 1.0, count):
            x = (1 - s) * start + s * end
            world = frames_p[k] + frames_R[k] @ x
            offset.append(x)
            radius.append(capsules.radius[c])
            body_offset.append(data.xmat[b].reshape(3, 3).T @ (world - data.xpos[b]))
            segment.append(k)
            body.append(bodies[c])
    return ControlPoints(
        offset=np.reshape(offset, (len(offset), 3)),
        radius=np.array(radius, float),
        body_offset=np.reshape(body_offset, (len(offset), 3)),
        segment=tuple(segment),
        body=tuple(body),
    )
