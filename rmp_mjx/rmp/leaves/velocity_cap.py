"""Joint-velocity cap: a brake that wakes up near the speed limit."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.rmp.leaf import ScalarLeaf


class VelocityCap(ScalarLeaf):
    r"""Damping whose metric grows without bound as the speed reaches its limit.

    With $s = (|\dot q| - (v_\max - \delta)) / \delta$, for s > 0:

    $$
    m = \min\Bigl(w \frac{s^2}{1 - s^2}, \text{cap}\Bigr), \qquad
    a = -k\, \mathrm{sign}(\dot q)\, s\, \delta
    $$

    and zero below the damping region; at and beyond the limit the metric is the cap.
    Explicit integration needs ``gain * dt < 2``.

    Source: the joint-velocity-cap policy of NVIDIA's Lula RMPflow, made continuous.
    """

    v_max: Float[Array, " n"] | Float[Array, ""] | float
    """Speed limit, [rad/s]."""
    region: Float[Array, " n"] | Float[Array, ""] | float = 0.3
    """Width of the damping region below the limit, [rad/s]."""
    gain: Float[Array, ""] | float = 100.0
    """Damping of the excess over the region's start, [1/s]."""
    weight: Float[Array, ""] | float = 1.0
    """Metric scale."""
    cap: Float[Array, ""] | float = 1e3
    """Largest metric."""

    def scalar(
        self, x: Float[Array, " n"], xd: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Force and metric, elementwise; the position does not matter."""
        excess = jnp.maximum(jnp.abs(xd) - (self.v_max - self.region), 0.0)
        s2 = (excess / self.region) ** 2
        # w s2 / (1 - s2) meets the cap at s2 = cap / (cap + w): clamp there.
        s2 = jnp.minimum(s2, self.cap / (self.cap + self.weight))
        m = self.weight * s2 / (1.0 - s2)
        return -m * self.gain * jnp.sign(xd) * excess, m
