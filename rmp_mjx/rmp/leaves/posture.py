"""Posture leaf: a rest configuration for the null space."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.math import critical_damping
from rmp_mjx.rmp.algebra import RMP
from rmp_mjx.rmp.leaf import Leaf


class Posture(Leaf):
    r"""Spring and damper in joint space, $a = k_q (q_0 - q) - k_d \dot q$.

    Used as a leaf its metric is ``weight`` times the identity, or times the inertia
    given at the call. Used as ``resolve``'s ``qdd_0`` only `acceleration` matters.

    Source: Martin-Martin et al., "VICES" (2019): null-space gains 10 and 2 sqrt(10).
    """

    q_0: Float[Array, " n"]
    """Rest configuration, (n,), [rad]."""
    kq: Float[Array, " n"] | Float[Array, ""] | float = 10.0
    """Stiffness, [1/s^2]."""
    kd: Float[Array, " n"] | Float[Array, ""] | float | None = None
    """Damping, [1/s]; ``2 sqrt(kq)`` if None."""
    weight: Float[Array, ""] | float = 0.02
    """Scale of the metric."""

    def acceleration(
        self, q: Float[Array, " n"], qd: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """Acceleration towards the rest configuration, (n,), [rad/s^2]."""
        kd = critical_damping(self.kq) if self.kd is None else self.kd
        return self.kq * (self.q_0 - q) - kd * qd

    def __call__(
        self,
        x: Float[Array, " n"],
        xd: Float[Array, " n"],
        Mq: Float[Array, "n n"] | None = None,
    ) -> RMP:
        """RMP at ``x`` = q, ``xd`` = qd; metric ``weight * Mq`` (identity if None)."""
        metric = jnp.eye(x.shape[0], dtype=x.dtype) if Mq is None else Mq
        M = self.weight * metric
        return RMP(f=jnp.matmul(M, self.acceleration(x, xd), precision="highest"), M=M)
