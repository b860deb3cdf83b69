"""From a policy's action in [-1, 1]^12 to physical units, and to a set-point."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Real

from rmp_mjx.control.arguments import check
from rmp_mjx.math import exp_so3
from rmp_mjx.pytree import Constant, Pytree
from rmp_mjx.types import Action, Setpoint

ACTION_SIZE = 12
"""dpos (3), drot (3), kp_pos (3), kp_ori (3), in this order."""


class ActionRange(Pytree):
    """What -1 and 1 mean. Stiffness is spaced logarithmically."""

    dpos: Float[Constant, ""] | float = 0.05
    """Largest displacement per axis [m]."""
    drot: Float[Constant, ""] | float = 0.2
    """Largest rotation per axis [rad]."""
    kp_min: Float[Constant, ""] | float = 10.0
    """Least stiffness [1/s^2]."""
    kp_max: Float[Constant, ""] | float = 300.0
    """Greatest stiffness [1/s^2]."""

    def decode(self, action: Float[ArrayLike, " 12"]) -> Action:
        """Map [-1, 1]^12 to physical units; values outside are clipped.

        A non-finite entry counts as zero: no displacement, middle stiffness.

        Raises:
            ValueError: The action has another shape or no floats.
        """
        check("action", action, (ACTION_SIZE,))
        action = jnp.asarray(action)
        u = jnp.clip(jnp.where(jnp.isfinite(action), action, 0.0), -1.0, 1.0)
        ratio = self.kp_max / jnp.asarray(self.kp_min, u.dtype)
        kp = self.kp_min * ratio ** (0.5 * (u[6:] + 1.0))
        return Action(
            dpos=self.dpos * u[:3],
            drot=self.drot * u[3:6],
            kp_pos=kp[:3],
            kp_ori=kp[3:],
        )


def compose_setpoint(
    p: Float[Array, " 3"],
    R: Float[Array, "3 3"],
    action: Action,
    time: Real[ArrayLike, ""],
) -> Setpoint:
    """Displace the current site pose by the action (paper, section II-B).

    Args:
        p: Current site position, (3,) [m].
        R: Current site orientation, (3, 3).
        action: Displacement and stiffness in physical units.
        time: Time of the policy step [s].
    """
    return Setpoint(
        p_des=p + action.dpos,
        R_des=jnp.matmul(exp_so3(jnp.asarray(action.drot)), R, precision="highest"),
        kp_pos=action.kp_pos,
        kp_ori=action.kp_ori,
        time=jnp.asarray(time, p.dtype),
    )
