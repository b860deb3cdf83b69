"""Capsules around the links, and control points sampled along them."""

from __future__ import annotations

import mujoco
import numpy as np
from flax import struct
from jaxtyping import Float

from rmp_mjx.pytree import Pytree
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
    """Enclose every colliding geom of the carrier bodies in a capsule.

    Capsules and spheres are taken as they are; any other geom is enclosed by the
    capsule around the longest axis of its bounding box.

    Returns:
        The capsules, and the body name of each.
    """
    starts, ends, radii, segments, geoms, bodies = [], [], [], [], [], []
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        collides = model.geom_contype[geom] or model.geom_conaffinity[geom]
        if body not in carriers or not collides:
            continue
        start, end, radius = _enclosing_capsule(model, data, geom)
        k = int(segment[body])
        if k >= 0:
            start, end = ((x - frames_p[k]) @ frames_R[k] for x in (start, end))
        starts.append(start)
        ends.append(end)
        radii.append(radius)
        segments.append(k)
        geoms.append(model.geom(geom).name)
        bodies.append(model.body(body).name)
    capsules = Capsules(
        start=np.reshape(starts, (-1, 3)),
        end=np.reshape(ends, (-1, 3)),
        radius=np.array(radii, float),
        segment=tuple(segments),
        geom=tuple(geoms),
    )
    return capsules, bodies


def _enclosing_capsule(model, data, geom):
    centre, R = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
    size, kind = model.geom_size[geom], model.geom_type[geom]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return centre, centre, size[0]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        axis = R[:, 2] * size[1]
        return centre - axis, centre + axis, size[0]
    box_centre, half = np.split(model.geom_aabb[geom], 2)
    centre = centre + R @ box_centre
    long = int(np.argmax(half))
    axis = R[:, long] * half[long]
    return centre - axis, centre + axis, float(np.linalg.norm(np.delete(half, long)))


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
        for s in np.linspace(0.0, 1.0, count) if count > 1 else [0.5]:
            x = (1 - s) * start + s * end
            world = frames_p[k] + frames_R[k] @ x
            offset.append(x)
            radius.append(capsules.radius[c])
            body_offset.append(data.xmat[b].reshape(3, 3).T @ (world - data.xpos[b]))
            segment.append(k)
            body.append(bodies[c])
    return ControlPoints(
        offset=np.reshape(offset, (-1, 3)),
        radius=np.array(radius, float),
        body_offset=np.reshape(body_offset, (-1, 3)),
        segment=tuple(segment),
        body=tuple(body),
    )


def touching_pairs(
    model: mujoco.MjModel, capsules: Capsules, samples: int = 2000
) -> tuple[tuple[int, int], ...]:
    """Capsule pairs that self-collision has to watch.

    They are at least three joints apart (nearer ones touch by construction or are kept
    apart by a joint limit) and come within 2 cm of each other in one of `samples`
    configurations drawn within the joint limits (fixed seed).
    """
    candidates = [
        (far, near)
        for far, k in enumerate(capsules.segment)
        for near, j in enumerate(capsules.segment)
        if k - j >= 3
    ]
    limited = model.jnt_limited.astype(bool)
    low = np.where(limited, model.jnt_range[:, 0], -np.pi)
    high = np.where(limited, model.jnt_range[:, 1], np.pi)
    data = mujoco.MjData(model)
    ids = [model.geom(name).id for name in capsules.geom]
    touching: set[tuple[int, int]] = set()
    for q in np.random.default_rng(0).uniform(low, high, (samples, model.nq)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for far, near in set(candidates) - touching:
            gap = mujoco.mj_geomDistance(model, data, ids[far], ids[near], 0.1, None)
            if gap < 0.02:
                touching.add((far, near))
    return tuple(pair for pair in candidates if pair in touching)
