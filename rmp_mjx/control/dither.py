"""A small motion of the set-point that frees a hand at rest beside an obstacle."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rmp_mjx.math import ramp
from rmp_mjx.pytree import Constant, Pytree

RATIOS = (1.0, 0.618, 0.382)
"""Frequencies of the three axes, relative to the first: the curve does not close."""


class SetpointDither(Pytree):
    r"""Displacement of the set-point beside an obstacle, at clearance c and time t.

    $$
    A\, s\, e^{-|v|^2 / v_0^2}
    \bigl(\sin \omega t, \sin 0.618\, \omega t, \sin 0.382\, \omega t \bigr), \quad
    s = \mathrm{clip}\Bigl(\frac{c_{far} - c}{c_{far} - c_{near}}, 0, 1\Bigr)
    $$

    A tree is a function of the state. Where its forces balance the hand stays at rest,
    and a policy that acts on the state gives the same action for ever. The time, which
    is part of the set-point, breaks this balance.
    """

    amplitude: Float[Constant, ""] | float = 0.03
    """Largest displacement per axis, A [m]."""
    period: Float[Constant, ""] | float = 2.5
    """Period of the first axis [s]."""
    speed: Float[Constant, ""] | float = 0.1
    """Speed of the end effector above which the dither fades, v_0 [m/s]."""
    near: Float[Constant, ""] | float = 0.02
    """Clearance up to which the displacement is full [m]."""
    far: Float[Constant, ""] | float = 0.05
    """Clearance from which on it is zero [m]."""

    def __call__(
        self,
        time: Float[Array, ""] | float,
        room: Float[Array, ""],
        v: Float[Array, " 3"],
    ) -> Float[Array, " 3"]:
        """The displacement [m].

        Args:
            time: Time of the policy step [s].
            room: Clearance [m].
            v: Velocity of the end effector, (3,) [m/s].
        """
        share = ramp(room, self.near, self.far)
        still = jnp.exp(-jnp.dot(v, v) / self.speed**2)
        phase = (2.0 * np.pi * time / self.period) * jnp.array(RATIOS)
        return self.amplitude * share * still * jnp.sin(phase)
