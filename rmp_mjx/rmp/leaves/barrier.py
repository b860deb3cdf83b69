"""The one-dimensional safety barrier shared by collision and joint-limit leaves."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.rmp.leaf import Param, ScalarLeaf


class Barrier(ScalarLeaf):
    r"""Velocity-gated barrier on a signed distance ``d`` with rate ``xd = dd/dt``.

    $$
    \begin{split}
    v &= \min(\dot d, 0), \quad
    x = \max(d - \text{margin} + \tfrac12 v T, x_\min), \quad
    h = e^{-\max(\dot d, 0) / v_{out}} \\
    m &= h \min\bigl(\mu (1 - x/r)^2 (v^2 + \epsilon) / x^4,\ \text{cap}\bigr) \\
    a &= -\eta v + v^2 / x + k_{out} \max(\text{margin} - d, 0) \\
    f &= m a
    \end{split}
    $$

    for $x < r$, and zero beyond. $v^2 / x$ is the geodesic curvature of the metric
    $v^2 / x^4$. ``eps`` keeps the metric up in a slow approach. ``k_out`` resists a
    constant push. The metric fades over the speed ``v_out`` while the body leaves; if
    it ended at zero speed, a body pushed against the barrier would come closer at
    every rebound. T is the time that the motors need to stop the arm: what counts is
    the gap that would be left then. Explicit integration needs ``eta * dt < 2``.
    docs/maths.md derives each term.

    Source: the collision leaf of Shaw et al., "RMPs for Safe Impedance Control in
    Contact-Rich Manipulation" (2021), signs corrected, with the GDS curvature of
    RMPflow (Cheng et al., 2018).
    """

    mu: Param = 1e-3
    """Metric scale, [unit^2 s^2]."""
    eps: Param = 0.2
    """Velocity floor of the metric, [unit^2/s^2]."""
    eta: Param = 20.0
    """Damping, [1/s]."""
    r: Param = 0.3
    """Range beyond the margin at which the barrier vanishes, [unit]."""
    margin: Param = 0.01
    """Distance at which the barrier is centred, [unit]."""
    x_min: Param = 5e-3
    """Clamp of the distance to the margin, [unit], > 0."""
    cap: Param = 1e3
    """Largest metric, which bounds the condition of the root."""
    k_out: Param = 100.0
    """Outward stiffness inside the margin, [1/s^2]."""
    v_out: Param = 3e-3
    """Release speed: the metric fades over it while the body leaves, [unit/s], > 0."""
    stop_time: Param = 0.0
    """Time T to stop [s]; the controllers set it."""

    def braking(self, stop_time: Float[Array, ""] | float) -> Barrier:
        """The barrier for an arm that needs this time to stop [s]."""
        return self.replace(stop_time=stop_time)

    def standing_off(self, distance: Float[Array, ""] | float) -> Barrier:
        """The barrier with a margin that is wider by a distance."""
        return self.replace(margin=self.margin + distance)

    def scalar(
        self, x: Float[Array, "*s"], xd: Float[Array, "*s"]
    ) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
        """Force and metric at distances ``x`` and speeds ``xd``, elementwise.

        Args:
            x: Signed distances (positive outside); +inf means nothing there.
            xd: Their rates; negative means approaching.

        Returns:
            Natural force ``f`` and metric ``m``, shaped like ``x``.
        """
        return self._scalar(x, xd, 0.0)

    def scalar_against(
        self, x: Float[Array, "*s"], xd: Float[Array, "*s"], push: Float[Array, "*s"]
    ) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
        """As `scalar`, where contacts accelerate the distances by ``push``."""
        return self._scalar(x, xd, jnp.maximum(-push, 0.0))

    def _scalar(
        self, x: Array, xd: Array, pressed: Array | float
    ) -> tuple[Array, Array]:
        """Force and metric, with the acceleration that contacts take."""
        braking = 0.5 * self.stop_time * jnp.minimum(xd, 0.0)
        gap = jnp.maximum(x - self.margin + braking, self.x_min)
        active = gap < self.r
        gap = jnp.where(active, gap, 1.0)
        depth = jnp.where(active, jnp.maximum(self.margin - x, 0.0), 0.0)
        v = jnp.where(active, jnp.minimum(xd, 0.0), 0.0)
        hold = jnp.where(active, jnp.exp(-jnp.maximum(xd, 0.0) / self.v_out), 0.0)
        fade = 1.0 - gap / self.r
        # Both end in a division: XLA's CPU backend stores its result for all who need
        # it, where it would compute what ends in a product again for each of them.
        # The bounds keep far gaps and infinite caps finite in float32.
        gap4 = jnp.minimum(gap, 1e3) ** 4
        m = self.mu * fade**2 * (v * v + self.eps)
        m = hold * jnp.minimum(m, jnp.minimum(self.cap, 1e25) * gap4) / gap4
        pull = v * v + gap * (self.k_out * depth - self.eta * v + pressed)
        return m * pull / gap, m
