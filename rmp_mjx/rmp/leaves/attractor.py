"""Impedance attractors on position (R^3) and orientation (SO(3))."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.math import critical_damping, orientation_error, skew, unskew
from rmp_mjx.pytree import Constant
from rmp_mjx.rmp.algebra import RMP
from rmp_mjx.rmp.leaf import Leaf, Param


class PositionAttractor(Leaf):
    """Spring and damper towards a point: ``a = kp (p_des - x) - kd xd``, metric I.

    Source: Shaw et al. (2021), eq. 7, with the sign that attracts. The same formula
    serves a coordinate of any dimension.
    """

    p_des: Float[Constant, " m"]
    """Target, (m,), [m]."""
    kp: Param
    """Stiffness per axis or scalar, [1/s^2]."""
    kd: Param | None = None
    """Damping, [1/s]; ``2 sqrt(kp)`` (critical) if None."""
    weight: Param = 1.0
    """Scale of the identity metric."""

    def __call__(self, x: Float[Array, " m"], xd: Float[Array, " m"]) -> RMP:
        """RMP at position ``x`` (m,) [m] and velocity ``xd`` (m,) [m/s]."""
        kd = critical_damping(self.kp) if self.kd is None else self.kd
        a = self.kp * (self.p_des - x) - kd * xd
        metric = self.weight * jnp.eye(x.shape[0], dtype=x.dtype)
        return RMP(f=self.weight * a, M=metric)


def orientation_attractor(
    R: Float[Array, "3 3"],
    omega: Float[Array, " 3"],
    R_des: Float[Constant, "3 3"],
    kp: Param,
    kd: Param | None = None,
    weight: Param = 1.0,
    feedforward: Param = 0.0,
) -> RMP:
    r"""Orientation impedance on the angular velocity: metric I on $\omega$.

    $$
    \alpha = k_p\, e_r(R, R_{des}) - k_d\, \omega + \alpha_0.
    $$

    Pull it back with the angular Jacobian (world frame) and its bias ``Jdot qd``.

    Args:
        R: Current orientation, (3, 3).
        omega: Angular velocity in the world frame, (3,), [rad/s].
        R_des: Desired orientation, (3, 3).
        kp: Stiffness about the world axes, (3,) or scalar, [1/s^2].
        kd: Damping, [1/s]; ``2 sqrt(kp)`` if None.
        weight: Scale of the identity metric.
        feedforward: Further angular acceleration, (3,) or scalar, [rad/s^2].

    Returns:
        RMP on the angular velocity; f (3,), M (3, 3).

    Source: Shaw et al. (2021), eq. 8; Martin-Martin et al., "VICES" (2019).
    """
    damping = critical_damping(kp) if kd is None else kd
    alpha = kp * orientation_error(R, R_des) - damping * omega
    alpha = alpha + feedforward
    return RMP(f=weight * alpha, M=weight * jnp.eye(3, dtype=R.dtype))


class OrientationAttractor(Leaf):
    r"""Orientation impedance as a leaf of the generic tree.

    Its node coordinate is the rotation matrix itself, row by row: ``x = R.reshape(9)``,
    so the task map is just ``q -> R(q)``, with no chart and no singularity. Embedding
    the metric $W = w I$ and the torque $\tau$ of `orientation_attractor` as

    $$
    M = \tfrac14 B W B^T, \quad f = \tfrac12 B \tau, \quad
    B\,\omega = \mathrm{vec}([\omega]_\times R), \quad B^T B = 2 I
    $$

    makes the pullback to q exactly $J_\omega^T W J_\omega$ and
    $J_\omega^T (\tau - W \dot J_\omega \dot q)$: the centripetal part
    $[\omega]^2 R$ of the curvature is orthogonal to B's range.
    """

    R_des: Float[Constant, "3 3"]
    """Desired orientation, (3, 3)."""
    kp: Param
    """Stiffness about the world axes or scalar, [1/s^2]."""
    kd: Param | None = None
    """Damping, [1/s]; ``2 sqrt(kp)`` if None."""
    weight: Param = 1.0
    """Scale of the identity metric on the angular velocity."""
    feedforward: Param = 0.0
    """Further angular acceleration, world frame, (3,) or scalar, [rad/s^2]."""

    def __call__(self, x: Float[Array, " 9"], xd: Float[Array, " 9"]) -> RMP:
        """RMP on the flattened rotation matrix; f (9,), M (9, 9)."""
        R = x.reshape(3, 3)
        omega = unskew(jnp.matmul(xd.reshape(3, 3), R.T, precision="highest"))
        rmp = orientation_attractor(
            R, omega, self.R_des, self.kp, self.kd, self.weight, self.feedforward
        )
        identity = jnp.eye(3, dtype=x.dtype)
        B = jnp.stack(
            [
                jnp.matmul(skew(identity[i]), R, precision="highest").reshape(9)
                for i in range(3)
            ],
            axis=1,
        )
        BW = jnp.matmul(B, rmp.M, precision="highest")
        return RMP(
            f=0.5 * jnp.matmul(B, rmp.f, precision="highest"),
            M=0.25 * jnp.matmul(BW, B.T, precision="highest"),
        )
