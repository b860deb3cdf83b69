"""Brax's PPO on the point mass: what a trainer costs when the task costs nothing.

The same task, sizes, epochs and minibatches as ours (`point_mass.SETTINGS`). Brax's
`train` compiles when it starts, so its rate is taken from its own clock
(``training/sps``, compilation left out) in the last of two epochs of a fixed length;
the time budget is ignored.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env
from brax.training.agents.ppo import (
    networks,
    train,
)

from benchmarks.peers.worker import Measure, serve
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


STEPS = 81_920
"""Environment steps of one measurement."""


class PointTask(Env):
    """The point mass in Brax's protocol."""

    @property
    def observation_size(self):
        """Entries of an observation."""
        return OBSERVATION_SIZE

    @property
    def action_size(self):
        """Entries of an action."""
        return ACTION_SIZE

    @property
    def backend(self):
        """No physics of Brax."""
        return "point mass"

    def reset(self, rng) -> Any:
        """Start somewhere."""
        return Point.start(rng, {})

    def step(self, state: Any, action):
        """One step."""
        return state.step(action)


def trainer_steps() -> Measure:
    """Environment steps a second of training, updates included."""
    given = SETTINGS
    sizes = given["hidden_sizes"]
    steps = given["num_envs"] * given["unroll_length"]

    def measure(seconds: float) -> float:
        del seconds
        rates = []
        train.train(
            environment=PointTask(),
            num_timesteps=STEPS // steps * steps,
            num_evals=3,
            num_eval_envs=1,
            episode_length=1000,
            wrap_env=True,
            num_envs=given["num_envs"],
            batch_size=given["num_envs"] // given["num_minibatches"],
            num_minibatches=given["num_minibatches"],
            num_updates_per_batch=given["num_updates_per_batch"],
            unroll_length=given["unroll_length"],
            learning_rate=given["learning_rate"],
            discounting=given["discounting"],
            gae_lambda=given["gae_lambda"],
            normalize_observations=True,
            network_factory=functools.partial(
                networks.make_ppo_networks,
                policy_hidden_layer_sizes=sizes,
                value_hidden_layer_sizes=sizes,
            ),
            progress_fn=lambda _, m: rates.append(m.get("training/sps")),
        )
        return float(rates[-1])

    return measure


if __name__ == "__main__":
    serve({"trainer_steps": trainer_steps}, ("brax", "jax", "numpy"))
