"""A small motion of the set-point that frees a hand which stands beside an obstacle."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rmp_mjx.control.yielding import Yielding
from rmp_mjx.pytree import Pytree

RATIOS = (1.0, 0.618, 0.382)
"""Rates of the three axes, relative to the first: the curve does not close."""


class Stirring(Pytree):
    r"""Displacement of the set-point beside an obstacle, at clearance c and time t.

    $$
    A\, s\, e^{-|v|^2 / v_0^2}
    \bigl(\sin \omega t, \sin 0.618\, \omega t, \sin 0.382\, \omega t \bigr), \quad
    s = \mathrm{clip}\Bigl(\frac{c_{far} - c}{c_{far} - c_{near}}, 0, 1\Bigr)
    $$

    A tree is a function of the state: where its forces balance it rests for good, and
    a policy that acts on the state with it. The time breaks the balance.
    """

    amplitude: Float[Array, ""] | float = 0.03
    """Largest displacement per axis, A [m]."""
    period: Float[Array, ""] | float = 2.5
    """Of the first axis [s]."""
    speed: Float[Array, ""] | float = 0.1
    """Speed of the end effector that counts as standing, v_0 [m/s]."""
    near: Float[Array, ""] | float = 0.02
    """Clearance up to which it is full [m]."""
    far: Float[Array, ""] | float = 0.05
    """Clearance from which on there is none [m]."""

    def __call__(
        self,
        time: Float[Array, ""] | float,
        room: Float[Array, ""],
        v: Float[Array, " 3"],
    ) -> Float[Array, " 3"]:
        """The displacement [m], from time [s], clearance [m] and velocity [m/s]."""
        share = Yielding(near=self.near, far=self.far).share(room)
        still = jnp.exp(-jnp.dot(v, v) / self.speed**2)
        phase = (2.0 * np.pi * time / self.period) * jnp.array(RATIOS)
        return self.amplitude * share * still * jnp.sin(phase)
