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


def stop_time(
    Mq: Float[Array, "n n"],
    load: Float[Array, " n"],
    qd: Float[Array, " n"],
    tau_max: Float[Constant, " n"],
    share: Float[Constant, ""] | float = 1.0,
) -> Float[Array, ""]:
    r"""Time in which the motors can bring all joints to rest together.

    With $\ddot q = -\dot q / T$, the joints come to rest in a straight line, after
    $\tfrac12 \dot q T$. Joint i has room for it if $|M_q \dot q|_i / T$ fits between
    the load and the torque limit on that side. T is the least time for which all do.

    Args:
        Mq: Inertia, (n, n).
        load: What the motors hold already: bias minus external torque, (n,) [N m].
        qd: Joint velocities, (n,) [rad/s].
        tau_max: Torque limits, (n,) [N m].
        share: Share of the torque that braking may count on. A joint that its load has
            pushed to the limit counts with a twentieth of it.

    Returns:
        The time [s].
    """
    momentum = jnp.matmul(Mq, qd, precision="highest")
    room = tau_max + jnp.sign(momentum) * load
    room = share * jnp.maximum(room, 0.05 * tau_max)
    return jnp.max(jnp.abs(momentum) / room, initial=0.0)


HORIZON = 5
"""Periods in which a joint may come to its greatest speed."""

ROOM = 0.01
"""Share of the greatest speed that is left free: within a period the inertia changes,
and joints were up to 0.3 % faster than planned."""


def speed_range(
    qd_max: Float[Constant, " n"],
    qd: Float[Array, " n"],
    w: Float[Array, " n"] | None,
    period: Float[Constant, ""] | float,
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """The accelerations that keep the joints within their speeds.

    Args:
        qd_max: Greatest speeds, (n,) [rad/s]. `ROOM` of them is left free.
        qd: Joint velocities, (n,) [rad/s].
        w: Joint acceleration by contacts, (n,) [rad/s^2]; None: nothing touches.
        period: Control period [s]. The rest of the way to the greatest speed takes
            `HORIZON` of them.

    Returns:
        Lowest and highest acceleration, (n,) each [rad/s^2].
    """
    limit = (1.0 - ROOM) * jnp.asarray(qd_max, qd.dtype)
    other = jnp.zeros_like(qd) if w is None else w
    time = HORIZON * period
    return (-limit - qd) / time - other, (limit - qd) / time - other


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
