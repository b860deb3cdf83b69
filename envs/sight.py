"""What a policy sees of the spheres: the nearest ones, and the arm's room to all."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rmp_mjx.math import safe_norm
from rmp_mjx.robot.kinematics import SiteState
from rmp_mjx.shapes import Spheres
from rmp_mjx.types import Constant

from .types import Entry

FADE = 0.15
"""Distance of a centre from the grip over which its closeness falls by e [m]."""

ROOM = 0.05
"""Gap to the arm over which the tightness falls by e [m]."""


def entries(count: int) -> tuple[Entry, ...]:
    """What the policy sees of the `count` nearest spheres; nothing of none."""
    if not count:
        return ()
    near = f"the {count} nearest spheres"
    return (
        Entry("sphere_direction", 3 * count, "-", f"to {near}, times closeness"),
        Entry("sphere_closeness", count, "-", "exp(-distance to the grip / 15 cm)"),
        Entry("sphere_velocity", 3 * count, "m/s", "less the grip's, times closeness"),
        Entry("tightness", 1, "-", "exp(-least gap of the arm to a sphere / 5 cm)"),
    )


def look(
    count: int,
    site: SiteState,
    spheres: Spheres,
    points: Float[Array, "p 3"],
    radii: Float[Constant, " p"],
) -> dict[str, Array]:
    r"""The values of `entries`.

    With the distance $d$ of a centre $c$ from the grip $p$, its closeness is
    $w = e^{-d / 15 cm}$. A sphere gives $w (c - p) / d$, $w$ and
    $w (\dot c - \dot p)$. All of them fade out where it does not matter: a slot without
    a sphere, all zeros, is a sphere far away.

    Args:
        count: Spheres k that are seen, the nearest first.
        site: The grip.
        spheres: Spheres as the controller sees them; those not in use are not seen.
        points: Control points of the arm [m].
        radii: Their radii [m].

    Returns:
        Directions (k, 3), closeness (k,), relative velocities (k, 3) [m/s], and the
        tightness (), which is 1 in contact and 0 without spheres.
    """
    active = jnp.asarray(spheres.active)
    slots = active.shape[0]
    if not slots:
        none, rows = jnp.zeros(count), jnp.zeros((count, 3))
        return _named(rows, none, rows, jnp.zeros(()))
    way = spheres.center - site.p
    distance = safe_norm(way)
    closeness = jnp.where(active, jnp.exp(-distance / FADE), 0.0)
    # A sphere's place is the number of closer ones: cheaper than a sort in a batch.
    ahead = closeness[:, None] > closeness
    tied = (closeness[:, None] == closeness) & np.triu(np.ones((slots, slots), bool), 1)
    place = jnp.sum(ahead | tied, axis=0)
    pick = (place == jnp.arange(count)[:, None]) * closeness
    to_it = way / jnp.maximum(distance, 1e-6)[:, None]
    moving = spheres.velocity - site.v
    gap = safe_norm(points[:, None] - spheres.center) - spheres.radius - radii[:, None]
    least = jnp.min(jnp.where(active, gap, jnp.inf))
    tightness = jnp.exp(-jnp.maximum(least, 0.0) / ROOM)
    return _named(_sum(pick, to_it), jnp.sum(pick, 1), _sum(pick, moving), tightness)


def _named(
    direction: Array, closeness: Array, velocity: Array, tightness: Array
) -> dict[str, Array]:
    return {
        "sphere_direction": direction,
        "sphere_closeness": closeness,
        "sphere_velocity": velocity,
        "tightness": tightness,
    }


def _sum(pick: Float[Array, "k o"], rows: Float[Array, "o 3"]) -> Float[Array, "k 3"]:
    """Each picked row, weighted; sums, since a GPU's matrix product is not exact."""
    return jnp.sum(pick[:, :, None] * rows, axis=1)
