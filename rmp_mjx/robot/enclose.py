r"""Capsules that enclose a convex hull with little room to spare.

About a fixed axis, let vertex i be at $t_i$ along it and $\rho_i$ off it. A capsule of
radius $r \ge \max_i \rho_i$ encloses all of them if its segment [a, b] has

$$
a \le \min_i \bigl(t_i + \sqrt{r^2 - \rho_i^2}\bigr), \quad
b \ge \max_i \bigl(t_i - \sqrt{r^2 - \rho_i^2}\bigr) .
$$

Direction and place of the axis and the radius, five numbers, are searched for the least
volume. A hull for which one capsule is too thick is cut by a plane. Both pieces are
convex, so capsules around their corners enclose all of the hull.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, QhullError

MOST = 3
"""Capsules that one hull gets at most."""

THICK = 2.0
"""A hull is cut where its capsule has more than this many times its volume."""

WORTH = 0.85
"""A cut must leave at most this share of the capsules' volume."""

_CUTS = (0.25, 0.5, 0.75)
"""Where a cut is tried, as a share of the hull's length along a principal axis."""


_TOLERANCE = {"xatol": 1e-3, "fatol": 1e-3}
"""When a search ends, relative to the hull's size."""


class Capsule(NamedTuple):
    """All points within a radius of a segment."""

    start: np.ndarray
    """One end of the segment, (3,) [m]."""
    end: np.ndarray
    """The other end, (3,) [m]."""
    radius: float
    """Radius [m]."""

    @property
    def volume(self) -> float:
        """Volume [m^3]."""
        length = float(np.linalg.norm(self.end - self.start))
        return np.pi * self.radius**2 * (length + 4.0 / 3.0 * self.radius)


def hull_volume(points: np.ndarray) -> float:
    """Volume of the convex hull of points (k, 3) [m^3]; 0 if they are flat."""
    try:
        return float(ConvexHull(points).volume)
    except QhullError:
        return 0.0


def enclosing_capsules(points: np.ndarray, most: int = MOST) -> list[Capsule]:
    """Capsules whose union contains the convex hull of points (k, 3) [m].

    One; more where one is too thick and cuts make the whole thinner. Points in a plane
    get one.

    Args:
        points: The corners of the hull, perhaps with points inside.
        most: How many capsules there may be.
    """
    whole = np.asarray(points, float)
    try:
        pieces = [whole[ConvexHull(whole).vertices]]
    except QhullError:  # a point, a line or a plane
        return [enclosing_capsule(whole)]
    capsules = [enclosing_capsule(pieces[0])]
    limit = THICK * hull_volume(pieces[0])
    for _ in range(most - 1):
        volumes = [capsule.volume for capsule in capsules]
        k = int(np.argmax(volumes))
        halves = _best_cut(pieces[k]) if sum(volumes) > limit else None
        if halves is None:
            break
        both = [enclosing_capsule(half) for half in halves]
        if sum(capsule.volume for capsule in both) > WORTH * volumes[k]:
            break
        pieces[k : k + 1], capsules[k : k + 1] = halves, both
    return capsules


def enclosing_capsule(points: np.ndarray, steps: int = 400) -> Capsule:
    """The capsule of nearly the least volume that contains all points (k, 3) [m].

    Args:
        points: Points, in any position.
        steps: Steps of the search about each principal axis.
    """
    centre, axes, half = _principal(points)
    scale = max(float(half.max()), 1e-9)
    x = (points - centre) @ axes / scale
    outer = x[_extreme(x)]
    best = None
    for long in range(3):
        local = np.roll(outer, 2 - long, axis=1)  # the axis that is tried becomes z

        def volume(p: np.ndarray, local: np.ndarray = local) -> float:
            return _about(local, p).volume

        start = np.concatenate([np.zeros(4), [1e-3]])
        simplex = start + np.vstack([np.zeros(5), 0.2 * np.eye(5)])
        found = minimize(
            volume,
            start,
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "maxfev": steps, **_TOLERANCE},
        )
        if best is None or found.fun < best[0]:
            best = found.fun, long, _about(np.roll(x, 2 - long, axis=1), found.x)
    assert best is not None
    _, long, capsule = best
    start, end = (
        centre + scale * axes @ np.roll(e, long - 2)
        for e in (capsule.start, capsule.end)
    )
    off = distance_to_segment(points, start, end)
    return Capsule(start, end, float(off.max()) * (1.0 + 1e-9))


def distance_to_segment(
    points: np.ndarray, start: np.ndarray, end: np.ndarray
) -> np.ndarray:
    """Distances of points (..., 3) from the segment between two points [m]."""
    along = end - start
    square = max(float(along @ along), 1e-30)
    s = np.clip((points - start) @ along / square, 0.0, 1.0)
    return np.linalg.norm(points - start - s[..., None] * along, axis=-1)


def _about(points: np.ndarray, p: np.ndarray) -> Capsule:
    """The shortest capsule about an axis near z: shift (2), tilt (2), more radius."""
    shift, tilt = np.array([p[0], p[1], 0.0]), np.array([p[2], p[3], 1.0])
    u = tilt / np.sqrt(tilt @ tilt)
    away = points - shift
    t = away @ u
    square = np.maximum(np.einsum("ij,ij->i", away, away) - t**2, 0.0)
    radius = np.sqrt(square.max()) * (1.0 + abs(p[4]))
    reach = np.sqrt(np.maximum(radius**2 - square, 0.0))
    a, b = np.min(t + reach), np.max(t - reach)
    if a > b:  # a sphere of this radius has room for all
        a = b = (a + b) / 2
    return Capsule(shift + a * u, shift + b * u, float(radius))


def _extreme(points: np.ndarray, count: int = 100) -> np.ndarray:
    """Indices of the points that lie farthest in evenly spread directions."""
    k = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    ring = np.sqrt(1.0 - z**2)
    directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), z])
    return np.unique(np.argmax(points @ directions, axis=0))


def _principal(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middle of the box along the principal axes, these as columns, half its sides."""
    axes = np.linalg.svd(points - points.mean(0), full_matrices=True)[2].T
    x = points @ axes
    low, high = x.min(0), x.max(0)
    return axes @ (low + high) / 2, axes, (high - low) / 2


def _best_cut(points: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """The two pieces of a hull, of those tried, that thin capsules enclose best."""
    centre, axes, half = _principal(points)
    best, least = None, np.inf
    for k in range(3):
        for share in _CUTS:
            level = centre @ axes[:, k] + (2 * share - 1) * half[k]
            pieces = _cut(points, axes[:, k], level)
            if pieces is None:
                continue
            size = sum(enclosing_capsule(p, steps=60).volume for p in pieces)
            if size < least:
                best, least = pieces, size
    return best


def _cut(
    points: np.ndarray, normal: np.ndarray, level: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Corners of the two pieces of a hull, below and above a plane; None if flat."""
    hull = ConvexHull(points)
    edges = np.concatenate([hull.simplices[:, [i, i - 1]] for i in range(3)])
    a, b = points[edges[:, 0]], points[edges[:, 1]]
    above, over = a @ normal - level, b @ normal - level
    cross = above * over < 0
    s = above[cross] / (above[cross] - over[cross])
    on = a[cross] + s[:, None] * (b[cross] - a[cross])
    height = points @ normal - level
    pieces = (np.concatenate([points[side], on]) for side in (height <= 0, height >= 0))
    try:
        below, top = (piece[ConvexHull(piece).vertices] for piece in pieces)
    except (QhullError, ValueError):
        return None
    return below, top
