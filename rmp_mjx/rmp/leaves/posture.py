"""Posture leaf: a rest configuration for the null space."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.math import critical_damping
from rmp_mjx.pytree import Constant
from rmp_mjx.rmp.algebra import RMP
from rmp_mjx.rmp.leaf import Leaf, Param


class Posture(Leaf):
    r"""Spring and damper in joint space, $a = k_q (q_0 - q) - k_d \dot q$.

    Used as a leaf its metric is ``weight`` times the identity, or times the inertia
    given at the call. Used as ``resolve``'s ``qdd_0`` only `acceleration` matters.

    Source: Martin-Martin et al., "VICES" (2019): null-space gains 10 and 2 sqrt(10).
    """

    q_0: Float[Constant, " n"]
    """Rest configuration, (n,), [rad]."""
    kq: Param = 10.0
    """Stiffness, [1/s^2]."""
    kd: Param | None = None
    """Damping, [1/s]; ``2 sqrt(kq)`` if None."""
    weight: Param = 0.02
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


def soft_posture(q_0: Float[Constant, " n"]) -> Posture:
    """A soft, overdamped posture: the hand can turn past obstacles, and stays calm.

    Args:
        q_0: Rest configuration, (n,), [rad].
    """
    return Posture(q_0=q_0, kq=2.5, kd=10.0)
