"""Damping leaf: resists motion along its coordinate."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.rmp.leaf import ScalarLeaf


class Damping(ScalarLeaf):
    """Uniform damping ``a = -eta xd`` with metric ``weight``."""

    eta: Float[Array, "*s"] | float = 1.0
    """Damping, [1/s]."""
    weight: Float[Array, "*s"] | float = 1.0
    """Metric."""

    def scalar(
        self, x: Float[Array, "*s"], xd: Float[Array, "*s"]
    ) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
        """Force and metric, elementwise; the position does not matter."""
        m = jnp.broadcast_to(jnp.asarray(self.weight, x.dtype), x.shape)
        return -m * self.eta * xd, m
