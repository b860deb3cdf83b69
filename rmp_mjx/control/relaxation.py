"""Less weight for the orientation where the hand has little room to turn."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.math import ramp
from rmp_mjx.pytree import Constant, Pytree


class OrientationRelaxation(Pytree):
    r"""Weight of the orientation attractor at a distance c from an obstacle or a limit.

    $$
    h = h_{min}^{\,s}, \quad
    s = \mathrm{clip}\Bigl(\frac{c_{far} - c}{c_{far} - c_{near}}, 0, 1\Bigr)
    $$

    The identity metrics of the two attractors weigh 1 rad/s^2 like 1 m/s^2. So a hand
    that meets an obstacle would rather stop than turn by a degree. With a lower weight
    the reaction of the collision leaves turns the hand out of the way. If the weight is
    the square of a length, a turn counts as far as it moves a point at that distance.

    Source: a state-dependent edge weight, as in RMPfusion (Li et al., 2019).
    """

    min_weight: Float[Constant, ""] | float = 1e-3
    """Least weight, [m^2/rad^2], > 0; with 1 the orientation is never relaxed."""
    near: Float[Constant, ""] | float = 0.015
    """Distance up to which the weight is ``min_weight``, [m] or [rad]."""
    far: Float[Constant, ""] | float = 0.07
    """Distance from which on the weight is 1, [m] or [rad]."""

    def __call__(self, room: Float[Array, ""]) -> Float[Array, ""]:
        """The weight at a distance [m] or [rad]; 1 if that is infinite."""
        share = ramp(room, self.near, self.far)
        return jnp.asarray(self.min_weight, room.dtype) ** share


def joint_limit_relaxation() -> OrientationRelaxation:
    """The default near joint limits; distances in rad."""
    return OrientationRelaxation(min_weight=1e-3, near=0.2, far=1.2)
