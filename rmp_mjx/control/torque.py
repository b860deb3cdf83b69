"""From a joint acceleration to torques that the actuators can give."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.pytree import Constant


def scale_torque(
    dynamic: Float[Array, " n"],
    bias: Float[Array, " n"],
    tau_max: Float[Constant, " n"],
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    r"""Torque within the limits that keeps the direction of the acceleration.

    $$
    \tau = b + k\, M_q \ddot q, \quad k \in [0, 1] \text{ as large as fits.}
    $$

    Clipping each joint separately would change the direction of the acceleration,
    perhaps into an obstacle. A bias beyond the limits is clipped.

    Args:
        dynamic: Mq qdd, (n,) [N m].
        bias: Coriolis and gravity, (n,) [N m].
        tau_max: Actuator limits, (n,) [N m].

    Returns:
        Torque (n,) [N m] and the scale k.
    """
    bias = jnp.clip(bias, -tau_max, tau_max)
    room = tau_max - jnp.sign(dynamic) * bias
    size = jnp.abs(dynamic)
    fits = size <= room
    k = jnp.min(jnp.where(fits, 1.0, room / jnp.where(fits, 1.0, size)))
    return jnp.clip(bias + k * dynamic, -tau_max, tau_max), k


def clip_torque(
    tau: Float[Array, " n"], tau_max: Float[Constant, " n"]
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Clip each joint separately, as VICES and robosuite do.

    Returns:
        Torque (n,) [N m] and the least fraction of a demanded torque that is met.
    """
    clipped = jnp.clip(tau, -tau_max, tau_max)
    size = jnp.abs(tau)
    over = size > tau_max
    return clipped, jnp.min(jnp.where(over, tau_max / jnp.where(over, size, 1.0), 1.0))
