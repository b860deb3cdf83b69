"""The obstacle spheres of an episode: their motion, and what the controller sees."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rmp_mjx.obstacles import Obstacles
from rmp_mjx.pytree import Pytree
from rmp_mjx.types import Constant

AWAY = (0.0, 0.0, -5.0)
"""Position of a sphere that found no place [m]."""


class Spheres(Pytree):
    """State of the spheres besides their positions."""

    placed: Bool[Array, " k"]
    """Which of them found a place."""
    velocity: Float[Array, "k 3"]
    """Their velocities [m/s]."""

    @staticmethod
    def start(rng: Array, placed: Bool[Array, " k"], speed: float) -> Spheres:
        """Random directions, all at the same speed [m/s]."""
        direction = jax.random.normal(rng, (placed.shape[0], 3))
        norm = jnp.linalg.norm(direction, axis=-1, keepdims=True)
        velocity = speed * direction / jnp.maximum(norm, 1e-9)
        return Spheres(placed, jnp.where(placed[:, None], velocity, 0.0))

    def move(
        self,
        centers: Float[Array, "k 3"],
        dt: float,
        low: Float[Constant, " 3"],
        high: Float[Constant, " 3"],
    ) -> tuple[Float[Array, "k 3"], Spheres]:
        """Move for `dt` [s]; a centre that leaves the box turns back at its wall."""
        centers = centers + dt * self.velocity
        outward = ((centers < low) & (self.velocity < 0)) | (
            (centers > high) & (self.velocity > 0)
        )
        return centers, Spheres(
            self.placed, jnp.where(outward, -self.velocity, self.velocity)
        )

    def perceive(
        self,
        slots: Obstacles,
        centers: Float[Array, "k 3"],
        radius: float,
        error: Float[Array, "k 3"] | float,
        delay: float,
    ) -> Obstacles:
        """Fill the sphere slots with what the controller sees.

        Args:
            slots: Obstacles with k sphere slots.
            centers: True centres, (k, 3) [m].
            radius: Radius [m].
            error: Error of the measured positions, (k, 3) [m].
            delay: Age of the measurement [s]. A sphere is seen at its old position,
                with its present velocity.
        """
        seen = centers - delay * self.velocity + error
        radii = jnp.full(self.placed.shape, radius)
        slots = slots.with_spheres(seen, radii, self.velocity)
        return slots.replace(spheres=slots.spheres.replace(active=self.placed))
