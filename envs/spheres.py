"""The obstacle spheres of an episode: how many, their motion, what is seen of them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rmp_mjx.metric import Metric
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.pytree import Pytree
from rmp_mjx.types import Constant

AWAY = (0.0, 0.0, -5.0)
"""Position of a sphere that is not there [m]."""


LEVEL = Metric("obstacle_level", "last", headline="level", table=("mean",))
"""The level of a `Course`."""

LEVEL_STEP = 0.1
"""By so much an episode raises or lowers the level of a `Course`."""


class Course(Pytree):
    """The curriculum of one environment, from episode to episode of its training."""

    level: Float[Array, ""]
    """Share of the spheres, and of their speed, that an episode may have, 0 to 1."""
    solved: Bool[Array, ""]
    """Whether the episode's task was solved."""
    harmed: Bool[Array, ""]
    """Whether an event happened in it."""

    @staticmethod
    def at(level: Float[Array, ""] | float) -> Course:
        """The start of an episode."""
        no = jnp.zeros((), bool)
        return Course(jnp.asarray(level, jnp.float32), no, no)

    def then(self, solved: Bool[Array, ""], harmed: Bool[Array, ""]) -> Course:
        """After one more policy step."""
        return Course(self.level, self.solved | solved, self.harmed | harmed)

    def following(self) -> Course:
        """The next episode: higher after success, lower after an event."""
        change = jnp.where(self.harmed, -1.0, jnp.where(self.solved, 1.0, 0.0))
        return Course.at(jnp.clip(self.level + LEVEL_STEP * change, 0.0, 1.0))


def draw_count(
    rng: Array, slots: int, random: bool, level: Float[Array, ""] | float = 1.0
) -> Bool[Array, " k"]:
    """Which of the slots have a sphere in an episode.

    Args:
        rng: Key.
        slots: Number of slots k.
        random: Whether the number is drawn from 0 to the most that the level allows,
            else it is the most.
        level: Share of the slots that may be used, 0 to 1.
    """
    most = jnp.round(jnp.asarray(level * slots)).astype(jnp.int32)
    count = jax.random.randint(rng, (), 0, most + 1) if random else most
    return jnp.arange(slots) < count


def draw_speed(rng: Array, most: Array | float, always: bool) -> Array | float:
    """Speed of an episode's spheres [m/s]: the most, or drawn.

    Args:
        rng: Key.
        most: Greatest speed [m/s].
        always: Whether it is the greatest in every episode. Else half of the episodes
            have spheres at rest, the others any speed up to it.
    """
    if always:
        return most
    still, share = jax.random.uniform(rng, (2,))
    return jnp.where(still < 0.5, 0.0, share * most)


class Spheres(Pytree):
    """State of the spheres besides their positions."""

    placed: Bool[Array, " k"]
    """Which of them are there."""
    velocity: Float[Array, "k 3"]
    """Their velocities [m/s]."""
    missing: Int[Array, ""]
    """How many more the episode should have, but they found no place."""

    @staticmethod
    def start(
        rng: Array,
        wanted: Bool[Array, " k"],
        fits: Bool[Array, " k"],
        speed: Array | float,
    ) -> Spheres:
        """Random directions, all at the same speed.

        Args:
            rng: Key.
            wanted: Which of them the episode should have.
            fits: Which of them found a place.
            speed: Speed [m/s].
        """
        placed = wanted & fits
        direction = jax.random.normal(rng, (placed.shape[0], 3))
        norm = jnp.linalg.norm(direction, axis=-1, keepdims=True)
        velocity = speed * direction / jnp.maximum(norm, 1e-9)
        velocity = jnp.where(placed[:, None], velocity, 0.0)
        return Spheres(placed, velocity, jnp.sum(wanted & ~fits))

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
        return centers, self.replace(
            velocity=jnp.where(outward, -self.velocity, self.velocity)
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
