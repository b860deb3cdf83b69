"""Random configurations of an arm, and how far it is from itself in them (NumPy).

`robot` is a `Robot` everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float


def random_configurations(
    robot: Any, count: int, seed: int = 0
) -> Float[np.ndarray, "s n"]:
    """Joint coordinates [rad or m], even within the limits or, without any, +-pi."""
    low = np.where(np.isfinite(robot.q_lower), robot.q_lower, -np.pi)
    high = np.where(np.isfinite(robot.q_upper), robot.q_upper, np.pi)
    return np.random.default_rng(seed).uniform(low, high, (count, robot.n))


def joint_frames(
    robot: Any, q: Float[np.ndarray, "s n"]
) -> tuple[Float[np.ndarray, "n s 3"], Float[np.ndarray, "n s 3 3"]]:
    """World positions [m] and orientations of the joint frames in s configurations."""
    p, R = np.zeros((len(q), 3)), np.tile(np.eye(3), (len(q), 1, 1))
    origins, rotations = [], []
    for j in range(robot.n):
        p, R = p + R @ robot.offset[j], R @ robot.rotation[j]
        shift = q[:, j] - robot.q_ref[j]
        if robot.hinge[j]:
            c, s = np.cos(shift)[:, None], np.sin(shift)[:, None]
            x, y, z = np.moveaxis(R, -1, 0)
            R = np.stack([c * x + s * y, c * y - s * x, z], axis=-1)
        else:
            p = p + R[..., 2] * shift[:, None]
        origins.append(p)
        rotations.append(R)
    return np.stack(origins), np.stack(rotations)


def capsule_gaps(
    robot: Any, q: Float[np.ndarray, "s n"], pairs: Sequence[tuple[int, int]]
) -> Float[np.ndarray, "s k"]:
    """Distances of the surfaces of k pairs of capsules in s configurations [m].

    Negative where they overlap.
    """
    radius, gaps = robot.capsules.radius, np.empty((len(q), len(pairs)))
    ends = capsule_ends(robot, q, sorted({c for pair in pairs for c in pair}))
    for i, (a, b) in enumerate(pairs):
        gaps[:, i] = segment_distance(*ends[a], *ends[b]) - radius[a] - radius[b]
    return gaps


def capsule_ends(
    robot: Any, q: Float[np.ndarray, "s n"], which: Sequence[int]
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """World positions of the ends of some capsules, (s, 3) each [m], by their index."""
    p, R = joint_frames(robot, q)
    capsules = robot.capsules
    start, end = np.asarray(capsules.start), np.asarray(capsules.end)
    segment = capsules.segment

    def in_world(point: np.ndarray, k: int) -> np.ndarray:
        return np.broadcast_to(point, (len(q), 3)) if k < 0 else p[k] + R[k] @ point

    return {
        c: (in_world(start[c], segment[c]), in_world(end[c], segment[c])) for c in which
    }


def segment_distance(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray
) -> np.ndarray:
    """Least distances of the segments from a to b and c to d, all (s, 3), (s,) [m].

    The nearest points are inside of both, where the lines are nearest, or one of them
    is an end.
    """
    u, v, w = b - a, d - c, a - c
    uu, uv, vv = ((x * y).sum(1) for x, y in ((u, u), (u, v), (v, v)))
    uw, vw = (u * w).sum(1), (v * w).sum(1)
    cross = np.maximum(uu * vv - uv**2, 1e-24)
    s = np.clip((uv * vw - vv * uw) / cross, 0.0, 1.0)
    inner = _to_segment(a + s[:, None] * u, c, d)
    ends = [_to_segment(*x) for x in ((a, c, d), (b, c, d), (c, a, b), (d, a, b))]
    return np.minimum.reduce([inner, *ends])


def _to_segment(x: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distances of points (s, 3) from the segments from a to b, (s,)."""
    u = b - a
    square = np.maximum((u * u).sum(1), 1e-24)
    t = np.clip(((x - a) * u).sum(1) / square, 0.0, 1.0)
    return np.linalg.norm(x - a - t[:, None] * u, axis=1)


def touching_pairs(robot: Any, samples: int = 2000) -> tuple[tuple[int, int], ...]:
    """Capsule pairs that self-collision has to watch.

    They are at least three joints apart (nearer ones touch by construction or are kept
    apart by a joint limit) and come within 2 cm of each other in one of `samples`
    configurations drawn within the joint limits (fixed seed).
    """
    candidates = [
        (far, near)
        for far, k in enumerate(robot.capsules.segment)
        for near, j in enumerate(robot.capsules.segment)
        if k - j >= 3
    ]
    gaps = capsule_gaps(robot, random_configurations(robot, samples), candidates)
    near = gaps.min(axis=0) < 0.02
    return tuple(pair for pair, close in zip(candidates, near, strict=True) if close)
