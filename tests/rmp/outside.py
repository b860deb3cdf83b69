"""Leaves that are not the library's: what the tests of the tree are made of."""

from __future__ import annotations

import jax.numpy as jnp

from rmp_mjx.rmp.leaf import Param, ScalarLeaf


class Drag(ScalarLeaf):
    """Uniform damping ``a = -eta xd`` with metric ``weight``."""

    eta: Param = 1.0
    """Damping, [1/s]."""
    weight: Param = 1.0
    """Metric."""

    def scalar(self, x, xd):
        m = jnp.broadcast_to(jnp.asarray(self.weight, x.dtype), x.shape)
        return -m * self.eta * xd, m


class GeodesicBarrier(ScalarLeaf):
    r"""The geodesic (GDS) form: metric, curvature, damping and optional potential.

    With $x = \max(d - \text{margin}, x_\min)$,
    $w = \mu \max(1 - x/r, 0)^2 / x^4$,
    $u = \epsilon + \max(-\dot x, 0)^2$, $g = u w$ and the potential
    $\Phi = \tfrac12 \alpha w$:

    $$
    M = g + \tfrac12 \dot x\, w\, u', \quad
    \xi = \tfrac12 \dot x^2 u\, w', \quad
    f = -\eta g \dot x - \xi - \Phi'
    $$

    Undamped, with eps = alpha = 0 and r = inf, an approaching mass obeys
    $\ddot x = \dot x^2 / x$: its speed falls in proportion to the distance. Below
    the cap, a tree of such leaves loses energy
    $\tfrac12 g \dot x^2 + \Phi$ at the rate $\eta g \dot x^2$. Beyond it
    f and M are scaled together: the leaf's own acceleration is unchanged.

    Source: Cheng et al., "RMPflow" (2018), geometric dynamical systems.
    """

    mu: Param = 1.0
    """Metric scale."""
    eps: Param = 0.0
    """Velocity floor, [m^2/s^2]."""
    eta: Param = 10.0
    """Damping, [1/s]."""
    alpha: Param = 0.0
    """Scale of the repulsive potential, [m^2/s^2]."""
    r: Param = float("inf")
    """Range beyond the margin, [m]; infinite as in the paper."""
    margin: Param = 0.0
    """Subtracted from the distance, [m]."""
    x_min: Param = 5e-3
    """Clamp of the distance to the margin, [m], > 0."""
    cap: Param = 1e5
    """Largest metric."""

    def scalar(self, x, xd):
        """Force and metric at distances ``x`` and speeds ``xd``, elementwise."""
        gap = x - self.margin
        inside = (gap < self.r) & jnp.isfinite(gap)
        clamped = gap < self.x_min
        gap = jnp.where(inside, jnp.maximum(gap, self.x_min), 1.0)
        inverse = 1.0 / gap
        fade = 1.0 - gap / self.r
        w = self.mu * (fade * inverse * inverse) ** 2
        dw = -2.0 * self.mu * fade * inverse**4 * (1.0 / self.r + 2.0 * fade * inverse)
        w = jnp.where(inside, w, 0.0)
        dw = jnp.where(inside & ~clamped, dw, 0.0)
        approach = jnp.minimum(xd, 0.0)
        u = self.eps + approach * approach
        m = w * (u + approach * approach)
        f = -self.eta * u * w * xd - 0.5 * dw * (xd * xd * u + self.alpha)
        scale = jnp.where(m > self.cap, self.cap / jnp.where(m > 0, m, 1.0), 1.0)
        return scale * f, scale * m
