"""How the orientation yields, so that the hand can turn past what stops it."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.pytree import Pytree


class Yielding(Pytree):
    r"""Weight of the orientation attractor where an obstacle or a limit leaves room c.

    $$
    h = h_{least}^{\,s}, \quad
    s = \mathrm{clip}\Bigl(\frac{c_{far} - c}{c_{far} - c_{near}}, 0, 1\Bigr)
    $$

    The identity metrics of the two attractors weigh 1 rad/s^2 like 1 m/s^2, so a hand
    that meets an obstacle would rather stop than turn by a degree. With ``least`` the
    square of a length, a turn counts as far as it moves what is at that distance, and
    the reaction of the collision leaves turns the hand out of the way.

    A state-dependent edge weight of the tree, as in RMPfusion (Li et al., 2019).
    """

    least: Float[Array, ""] | float = 1e-3
    """Weight where there is no room, [m^2/rad^2], > 0; 1: the orientation holds."""
    near: Float[Array, ""] | float = 0.015
    """Room up to which the weight is ``least``, [m] or [rad]."""
    far: Float[Array, ""] | float = 0.07
    """Room from which on the weight is 1, [m] or [rad]."""

    def __call__(self, room: Float[Array, ""]) -> Float[Array, ""]:
        """The weight at a distance [m] or [rad]; 1 if that is infinite."""
        return jnp.asarray(self.least, room.dtype) ** self.share(room)

    def share(self, room: Float[Array, ""]) -> Float[Array, ""]:
        """The share s in [0, 1] of the room that is lost."""
        inside = self.far - jnp.minimum(room, self.far)  # finite gradients at inf
        return jnp.minimum(inside / (self.far - self.near), 1.0)


def limit_yielding() -> Yielding:
    """Yielding near a joint's limit; room in rad."""
    return Yielding(least=1e-3, near=0.2, far=1.2)
