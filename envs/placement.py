"""Random placement of via points and obstacle spheres, of fixed cost under jit."""

from __future__ import annotations

from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rmp_mjx.types import Constant

CANDIDATES = 64
"""Placements drawn at once; the first valid one is used."""

Layout = Literal["far", "close"]

LAYOUTS: dict[Layout, dict[str, Any]] = {
    "far": {"points": ("surface", 0.08), "arm": 0.08},
    "close": {"points": ("center", 0.08), "arm": 0.03},
}
"""Clearances of a sphere [m]: to via points (of its surface or its centre) and of its
surface to the arm at the start of the episode."""


def sample_apart(
    rng: Array,
    count: int,
    low: Float[Constant, " 3"],
    high: Float[Constant, " 3"],
    gap: float,
) -> tuple[Float[Array, "count 3"], Bool[Array, ""]]:
    """Points in a box, at least `gap` from each other.

    Returns:
        The points and whether they keep the gap (else the most spread candidate).
    """
    sets = jax.random.uniform(rng, (CANDIDATES, count, 3), minval=low, maxval=high)
    delta = sets[:, :, None] - sets[:, None]
    distance = jnp.sqrt(jnp.sum(delta**2, axis=-1)) + jnp.eye(count) * 1e3
    spread = jnp.min(distance, axis=(1, 2))
    # The first set that is spread enough; a plain maximum would prefer the corners.
    best = jnp.argmax(jnp.where(spread >= gap, 1e3, spread))
    return sets[best], spread[best] >= gap


def place_spheres(
    rng: Array,
    count: int,
    radius: float,
    layout: Layout,
    low: Float[Constant, " 3"],
    high: Float[Constant, " 3"],
    points: Float[Array, "v 3"],
    arm_points: Float[Array, "p 3"],
    arm_radii: Float[Constant, " p"],
) -> tuple[Float[Array, "count 3"], Bool[Array, " count"]]:
    """Sphere centres in a box that keep the layout's clearances.

    Args:
        rng: Key.
        count: Number of spheres.
        radius: Their radius [m].
        layout: `far` or `close`.
        low: Lower corner of the box for the centres [m].
        high: Upper corner [m].
        points: Via points, (v, 3) [m].
        arm_points: Control points of the arm at the start, (p, 3) [m].
        arm_radii: Their radii, (p,) [m].

    Returns:
        Centres (count, 3), and which of them found a place.
    """
    centers = jax.random.uniform(rng, (count, CANDIDATES, 3), minval=low, maxval=high)
    fits = keeps_clear(centers, radius, layout, points, arm_points, arm_radii)
    first = jnp.argmax(fits, axis=1)
    chosen = jnp.take_along_axis(centers, first[:, None, None], axis=1)[:, 0]
    return chosen, jnp.any(fits, axis=1)


def keeps_clear(
    centers: Float[Array, "*s 3"],
    radius: float,
    layout: Layout,
    points: Float[Array, "v 3"],
    arm_points: Float[Array, "p 3"],
    arm_radii: Float[Constant, " p"],
) -> Bool[Array, "*s"]:
    """Whether spheres keep the layout's clearances; arguments as of `place_spheres`."""
    rule = LAYOUTS[layout]
    kind, to_points = rule["points"]
    to_points = to_points + (radius if kind == "surface" else 0.0)
    from_points = _distance(centers, points)
    from_arm = jnp.min(_all_distances(centers, arm_points) - arm_radii, axis=-1)
    return (from_points >= to_points) & (from_arm - radius >= rule["arm"])


def _all_distances(x: Array, y: Array) -> Array:
    return jnp.sqrt(jnp.sum((x[..., None, :] - y) ** 2, axis=-1))


def _distance(x: Array, y: Array) -> Array:
    return jnp.min(_all_distances(x, y), axis=-1)
