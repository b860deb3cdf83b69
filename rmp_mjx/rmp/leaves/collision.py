"""Collision leaves on a signed distance x (x > 0 outside; approaching is xd < 0)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.rmp.leaf import Param, ScalarLeaf
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
    r"""The collision leaf in the paper's form, its signs corrected.

    $$
    m = \max(-\dot x, 0)^2 / x^4, \quad a = -\eta \dot x, \quad f = m a
    $$

    As printed, the gate is $\max(\dot x, 0)$ and $a = +\eta \dot x$, which is wrong for
    a distance that is positive outside.

    Source: Shaw et al. (2021), the collision-avoidance leaf.
    """

    eta: Param = 2.0
    """Damping, [1/s]."""
    margin: Param = 0.0
    """Subtracted from the distance, [m]."""
    x_min: Param = 5e-3
    """Clamp of the distance to the margin, [m], > 0."""
    cap: Param = 1e5
    """Largest metric."""

    def standing_off(self, distance: Float[Array, ""] | float) -> PaperCollision:
        """The leaf with a margin that is wider by a distance."""
        return self.replace(margin=self.margin + distance)

    def scalar(
        self, x: Float[Array, "*s"], xd: Float[Array, "*s"]
    ) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
        """Force and metric at distances ``x`` and speeds ``xd``, elementwise."""
        there = jnp.isfinite(x)
        gap = jnp.where(there, jnp.maximum(x - self.margin, self.x_min), 1.0)
        approach = jnp.where(there, jnp.maximum(-xd, 0.0), 0.0)
        m = jnp.minimum((approach / (gap * gap)) ** 2, self.cap)
        return m * (-self.eta * xd), m
