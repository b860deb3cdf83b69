"""Brax's PPO on the point mass: what a trainer costs when the task costs nothing.

The same task, sizes, epochs and minibatches as ours (`point_mass.SETTINGS`). Brax's
`train` compiles when it starts, so its rate is taken from its own clock
(``training/sps``, compilation left out) in the last of two epochs of a fixed length;
the time budget is ignored.
"""

from __future__ import annotations

import functools
from typing import Any

from brax.envs.base import Env
from brax.training.agents.ppo import (
    networks,
    train,
)

from benchmarks.peers.point_mass import ACTION_SIZE, OBSERVATION_SIZE, SETTINGS, Point
from benchmarks.peers.worker import Measure, serve

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
