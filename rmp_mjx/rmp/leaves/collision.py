"""Collision leaves on a signed distance x (x > 0 outside; approaching is xd < 0)."""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.math import approach_gate
from rmp_mjx.rmp.leaf import ScalarLeaf
from rmp_mjx.rmp.leaves.barrier import Barrier


def collision_transit() -> Barrier:
    """Barrier for moving among obstacles: stays clear (about 3 cm); distances in m."""
    return Barrier(mu=1e-3, eps=0.2, eta=20.0, r=0.3, margin=0.01, cap=1e3)


def collision_near() -> Barrier:
    """Barrier for work close to surfaces: reaches them more freely; distances in m."""
    return Barrier(
        mu=7e-5, eps=0.007, eta=20.0, r=0.2, margin=0.005, cap=1e3, k_out=2.5e3
    )


class PaperCollision(ScalarLeaf):
    r"""The collision leaf in the paper's form, with switchable signs.

    ``signs="corrected"``: $m = \max(-\dot x, 0)^2 / x^4$,
    $a = -\eta \dot x$. ``signs="as_printed"`` reproduces the printed formulas,
    gate $\max(\dot x, 0)$ and $a = +\eta \dot x$, which are wrong for a
    distance that is positive outside: for ablations only. In both, f = m a.

    Source: Shaw et al. (2021), the collision-avoidance leaf.
    """

    eta: Float[Array, ""] | float = 2.0
    """Damping, [1/s]."""
    margin: Float[Array, ""] | float = 0.0
    """Subtracted from the distance, [m]."""
    x_min: Float[Array, ""] | float = 5e-3
    """Clamp of the distance to the margin, [m], > 0."""
    cap: Float[Array, ""] | float = 1e5
    """Largest metric."""
    signs: str = flax.struct.field(pytree_node=False, default="corrected")
    """"corrected" or "as_printed"; static."""

    def __post_init__(self):
        """Check the one static choice."""
        if self.signs not in ("corrected", "as_printed"):
            raise ValueError(
                f"signs must be 'corrected' or 'as_printed', not {self.signs!r}"
            )

    def scalar(
        self, x: Float[Array, "*s"], xd: Float[Array, "*s"]
    ) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
        """Force and metric at distances ``x`` and speeds ``xd``, elementwise."""
        sign = -1.0 if self.signs == "corrected" else 1.0
        there = jnp.isfinite(x)
        gap = jnp.where(there, jnp.maximum(x - self.margin, self.x_min), 1.0)
        gate = jnp.where(there, jnp.maximum(sign * xd, 0.0), 0.0)
        m = jnp.minimum((gate / (gap * gap)) ** 2, self.cap)
        return m * (sign * self.eta * xd), m


class GDSCollision(ScalarLeaf):
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

    mu: Float[Array, ""] | float = 1.0
    """Metric scale."""
    eps: Float[Array, ""] | float = 0.0
    """Velocity floor, [m^2/s^2]."""
    eta: Float[Array, ""] | float = 10.0
    """Damping, [1/s]."""
    alpha: Float[Array, ""] | float = 0.0
    """Scale of the repulsive potential, [m^2/s^2]."""
    r: Float[Array, ""] | float = float("inf")
    """Range beyond the margin, [m]; infinite as in the paper."""
    margin: Float[Array, ""] | float = 0.0
    """Subtracted from the distance, [m]."""
    x_min: Float[Array, ""] | float = 5e-3
    """Clamp of the distance to the margin, [m], > 0."""
    cap: Float[Array, ""] | float = 1e5
    """Largest metric."""

    def scalar(
        self, x: Float[Array, "*s"], xd: Float[Array, "*s"]
    ) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
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


class LulaCollision(ScalarLeaf):
    r"""The collision leaf of NVIDIA's Lula RMPflow, with its Franka defaults.

    $$
    \begin{split}
    a &= k_p e^{-x/l_p} - k_d (1 - \mathrm{sigmoid}(\dot x/v_d))
    \frac{\dot x}{x/l_d + e_d} \\
    m &= (1 - \mathrm{sigmoid}(\dot x/v_d)) (1 - x/r)^2
    \frac{\mu}{x/l_m + e_m}, \quad x < r
    \end{split}
    $$

    Its damping reaches ``kd / ed`` = 5000/s near contact, which chatters at control
    periods of a few milliseconds.

    Source: NVIDIA Isaac Sim documentation, RMPflow tuning guide.
    """

    kp: Float[Array, ""] | float = 800.0
    """Repulsion gain, [m/s^2]."""
    lp: Float[Array, ""] | float = 0.01
    """Length scale of the repulsion, [m]."""
    kd: Float[Array, ""] | float = 50.0
    """Damping gain, [1/s]."""
    ld: Float[Array, ""] | float = 0.04
    """Length scale of the damping, [m]."""
    ed: Float[Array, ""] | float = 0.01
    """Offset that bounds the damping, [-]."""
    vd: Float[Array, ""] | float = 0.01
    """Width of the velocity gate, [m/s]."""
    r: Float[Array, ""] | float = 0.5
    """Range, [m]."""
    mu: Float[Array, ""] | float = 1e4
    """Metric scale."""
    lm: Float[Array, ""] | float = 0.02
    """Length scale of the metric, [m]."""
    em: Float[Array, ""] | float = 1e-3
    """Offset that bounds the metric, [-]."""

    def scalar(
        self, x: Float[Array, "*s"], xd: Float[Array, "*s"]
    ) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
        """Force and metric at distances ``x`` and speeds ``xd``, elementwise."""
        inside = x < self.r
        x = jnp.where(inside, jnp.maximum(x, 0.0), 1.0)
        gate = approach_gate(xd, self.vd)
        a = self.kp * jnp.exp(-x / self.lp)
        a = a - self.kd * gate * xd / (x / self.ld + self.ed)
        m = gate * (1.0 - x / self.r) ** 2 * self.mu / (x / self.lm + self.em)
        m = jnp.where(inside, m, 0.0)
        return m * a, m
