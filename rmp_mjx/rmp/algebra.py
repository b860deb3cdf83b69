"""The RMP algebra in natural form: addition, pullback, resolve."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.math import psd_solve
from rmp_mjx.pytree import Pytree

_HIGHEST = "highest"


class RMP(Pytree):
    """A Riemannian Motion Policy ``(f, M)`` in natural form on an n-dimensional space.

    Its desired acceleration is any solution of ``M a = f``.
    """

    f: Float[Array, " n"]
    """Force, (n,): metric times acceleration."""
    M: Float[Array, "n n"]
    """Metric (importance weight), (n, n), symmetric positive semi-definite."""

    def __add__(self, other: RMP) -> RMP:
        """Sum of two RMPs on the same space: forces and metrics add."""
        return RMP(f=self.f + other.f, M=self.M + other.M)

    @classmethod
    def zero(cls, n: int, dtype=None) -> RMP:
        """The neutral element on an n-dimensional space."""
        return cls(f=jnp.zeros(n, dtype), M=jnp.zeros((n, n), dtype))


def pullback(rmp: RMP, J: Float[Array, "m n"], Jdot_qd: Float[Array, " m"]) -> RMP:
    r"""Pull a child RMP back through its task map (RMPflow, natural form).

    $$
    f = J^T (f_c - M_c \dot J \dot q), \quad M = J^T M_c J.
    $$

    Args:
        rmp: Child RMP; f (m,), M (m, m).
        J: Task-map Jacobian, (m, n).
        Jdot_qd: Curvature term, (m,), [child unit / s^2].

    Returns:
        RMP on the parent; f (n,), M (n, n).

    Source: Cheng et al., "RMPflow" (2018), eq. (6).
    """
    corrected = rmp.f - jnp.matmul(rmp.M, Jdot_qd, precision=_HIGHEST)
    f = jnp.matmul(corrected, J, precision=_HIGHEST)
    MJ = jnp.matmul(rmp.M, J, precision=_HIGHEST)
    return RMP(f=f, M=jnp.matmul(J.T, MJ, precision=_HIGHEST))


def resolve(
    rmp: RMP,
    W: Float[Array, "n n"] | None = None,
    qdd_0: Float[Array, " n"] | None = None,
) -> Float[Array, " n"]:
    r"""Acceleration of the root RMP, with an explicit regulariser.

    $$
    (M + W)\, \ddot q = f + W \ddot q_0.
    $$

    With ``W = eps * Mq`` (inertia) and ``qdd_0`` a posture acceleration, small ``eps``
    gives operational-space control with a dynamically consistent null space. Without
    ``W`` the metric itself must be positive definite.

    Args:
        rmp: Root RMP; f (n,), M (n, n).
        W: Regulariser, (n, n), symmetric PSD; none if omitted.
        qdd_0: Preferred acceleration, (n,), [rad/s^2]; zero if omitted.

    Returns:
        Acceleration qdd, (n,), [rad/s^2].

    Raises:
        ValueError: If ``qdd_0`` is given without ``W`` (it would be ignored).
    """
    if W is None:
        if qdd_0 is not None:
            raise ValueError("resolve: qdd_0 has no effect without a regulariser W")
        return psd_solve(rmp.M, rmp.f)
    f = rmp.f
    if qdd_0 is not None:
        f = f + jnp.matmul(W, qdd_0, precision=_HIGHEST)
    return psd_solve(rmp.M + W, f)
