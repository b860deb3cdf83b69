"""Axis-target leaf: align a body axis with a direction, free about the axis."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.math import critical_damping, safe_norm
from rmp_mjx.rmp.algebra import RMP
from rmp_mjx.rmp.leaf import Leaf


class AxisTarget(Leaf):
    r"""Attract a unit axis carried by a body to a direction of the world.

    The node coordinate is the axis itself, ``x = R(q) a`` in R^3, so the task map is
    ``q -> R(q) @ a``. The pull is $a = k_p (d - x) - k_d \dot x$ with metric I;
    its part along x is orthogonal to every motion of the axis and drops out of the
    pullback, which leaves $k_p \sin\theta$ towards the direction.

    Source: Li et al., "RMP2" (2021), axis-attractor policy; Lula's axis target.
    """

    direction: Float[Array, " 3"]
    """Desired direction in the world, (3,); need not be a unit vector."""
    kp: Float[Array, ""] | float = 100.0
    """Stiffness, [1/s^2]."""
    kd: Float[Array, ""] | float | None = None
    """Damping, [1/s]; ``2 sqrt(kp)`` if None."""
    weight: Float[Array, ""] | float = 1.0
    """Scale of the identity metric."""

    def __call__(self, x: Float[Array, " 3"], xd: Float[Array, " 3"]) -> RMP:
        """RMP at axis ``x`` (3,) and its rate ``xd`` (3,); f (3,), M (3, 3)."""
        kd = critical_damping(self.kp) if self.kd is None else self.kd
        norm = safe_norm(self.direction)
        target = self.direction / jnp.where(norm > 0, norm, 1.0)
        a = self.kp * (target - x) - kd * xd
        return RMP(f=self.weight * a, M=self.weight * jnp.eye(3, dtype=x.dtype))
