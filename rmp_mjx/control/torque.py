"""The torques that the actuators can give, and the nearest one to what is asked."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from rmp_mjx.pytree import Constant
from rmp_mjx.robot.model import Robot


def torque_range(
    robot: Robot,
    tau_last: Float[ArrayLike, " n"] | None,
    period: Float[Constant, ""] | float,
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """The torques that the actuators can give next, by their limits and their rate.

    Args:
        robot: The arm, with `tau_max` and perhaps `tau_rate_max`.
        tau_last: Torque of the last control step, (n,) [N m]; None: the rate is free.
        period: Time since then [s].

    Returns:
        Lowest and highest torque, (n,) each [N m].
    """
    high = jnp.asarray(robot.tau_max)
    if robot.tau_rate_max is None or tau_last is None:
        return -high, high
    last = jnp.clip(jnp.asarray(tau_last), -high, high)
    step = jnp.asarray(robot.tau_rate_max) * period
    return jnp.maximum(last - step, -high), jnp.minimum(last + step, high)


def clip_torque(
    tau: Float[Array, " n"], low: Float[Array, " n"], high: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Clip each joint separately, as VICES and robosuite do.

    Returns:
        Torque (n,) [N m], and -1 or 1 where it is at its lowest or highest value, else
        0, (n,).
    """
    limit = (tau >= high).astype(tau.dtype) - (tau <= low).astype(tau.dtype)
    return jnp.clip(tau, low, high), limit
