"""A point mass in JAX: a task that costs nothing, to measure a trainer's own time.

Used in two virtual environments: it imports JAX and flax only.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rmp_mjx.pytree import Pytree

OBSERVATION_SIZE = 34
"""Size of the trajectory task's observation."""

ACTION_SIZE = 12
"""Size of every task's action."""

SETTINGS: dict[str, Any] = {
    "num_envs": 256,
    "unroll_length": 16,
    "num_minibatches": 8,
    "num_updates_per_batch": 10,
    "hidden_sizes": (64, 64),
    "learning_rate": 3e-4,
    "discounting": 0.99,
    "gae_lambda": 0.97,
    "target_kl": 0.0,
}
"""Settings of both trainers."""


class Point(Pytree):
    """Position and velocity, observed with zero padding; the goal is the origin."""

    pipeline_state: jax.Array
    obs: jax.Array
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array]
    info: dict[str, Any]

    @staticmethod
    def start(rng: jax.Array, metrics: dict[str, jax.Array]) -> Point:
        """At rest, somewhere within a metre of the goal along each axis."""
        x = jnp.stack([jax.random.uniform(rng, (3,), minval=-1.0), jnp.zeros(3)])
        zero = jnp.zeros(())
        return Point(x, _observe(x), zero, zero, metrics, {})

    def step(self, action: jax.Array) -> Point:
        """20 Hz; the first three entries of the action accelerate the point."""
        v = self.pipeline_state[1] + 0.05 * action[:3]
        x = jnp.stack([self.pipeline_state[0] + 0.05 * v, v])
        reward = -jnp.sum(x[0] ** 2)
        return self.replace(pipeline_state=x, obs=_observe(x), reward=reward)


def _observe(x: jax.Array) -> jax.Array:
    return jnp.pad(x.reshape(-1), (0, OBSERVATION_SIZE - 6))
