"""Operational-space control with a fixed impedance: VICES without its stiffnesses."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import ArrayLike, Float

from rmp_mjx.control.vices import VICES
from rmp_mjx.pytree import Constant
from rmp_mjx.types import Action


class OSC(VICES):
    """VICES whose policy moves the set-point only.

    The stiffness entries of an action are ignored. Actions keep their size, so that the
    same policy network fits. The stiffness is that of robosuite's OSC_POSE controller.
    """

    kp: Float[Constant, ""] | float = 150.0
    """Stiffness in every direction [1/s^2]."""

    def decode(self, action: Float[ArrayLike, " 12"]) -> Action:
        """Physical units of a policy action in [-1, 1]^12."""
        free = super().decode(action)
        held = jnp.full_like(free.kp_pos, self.kp)
        return free.replace(kp_pos=held, kp_ori=held)
