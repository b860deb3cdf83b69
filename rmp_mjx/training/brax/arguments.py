"""Our hyper-parameters under the names of `brax.training.agents.ppo.train`."""

from typing import Any

import jax

from rmp_mjx.training.config import TrainConfig
from rmp_mjx.training.learning.networks import make_networks
from rmp_mjx.training.learning.ppo import MIN_OBS_STD
from rmp_mjx.training.learning.rollout import Env

NOT_IN_BRAX = ("value_learning_rate", "num_groups")
"""Hyper-parameters of ours that Brax has nothing for."""


def devices(config: TrainConfig) -> int:
    """The largest number of devices that share the environments equally."""
    rows = config.ppo.num_envs // config.ppo.num_minibatches
    most = min(jax.local_device_count(), config.run.num_devices or rows)
    return max(n for n in range(1, most + 1) if rows % n == 0)


def arguments(env: Env, config: TrainConfig) -> dict[str, Any]:
    """Keyword arguments of Brax's trainer, but for environment and callbacks.

    One of Brax's training steps is one iteration of ours: `num_envs` unrolls, and as
    many passes and minibatches over them. Brax calls back between its `num_evals`
    epochs; they are cut to one training step each, and its own evaluations are off.
    Networks, the bounds of normalised observations and the first deviation are ours.
    `target_kl` becomes Brax's `desired_kl`: where our updates stop, its learning rate,
    which is `learning_rate` at first, falls and rises to stay near it.

    Args:
        env: Single environment.
        config: Configuration.

    Returns:
        The arguments.
    """
    ppo = config.ppo
    networks = make_networks(
        env.observation_size, env.action_size, ppo.hidden_sizes, ppo.init_log_std
    )
    return {
        "num_timesteps": config.num_iterations * ppo.steps_per_iteration,
        "num_evals": config.num_iterations + 1,
        "run_evals": False,
        "num_eval_envs": 1,
        "wrap_env": False,
        "episode_length": env.episode_length,
        "max_devices_per_host": devices(config),
        "seed": ppo.seed,
        "num_envs": ppo.num_envs,
        "unroll_length": ppo.unroll_length,
        "num_minibatches": ppo.num_minibatches,
        "batch_size": ppo.num_envs // ppo.num_minibatches,
        "num_updates_per_batch": ppo.num_updates_per_batch,
        "discounting": ppo.discounting,
        "gae_lambda": ppo.gae_lambda,
        "learning_rate": ppo.learning_rate,
        "clipping_epsilon": ppo.clipping_epsilon,
        "entropy_cost": ppo.entropy_cost,
        "vf_loss_coefficient": ppo.vf_coefficient,
        "max_grad_norm": ppo.max_grad_norm,
        "learning_rate_schedule": "ADAPTIVE_KL" if ppo.target_kl else "NONE",
        "desired_kl": ppo.target_kl,
        "reward_scaling": ppo.reward_scaling,
        "normalize_observations": True,
        "normalize_observations_std_eps": MIN_OBS_STD**2,
        "network_factory": lambda *sizes, **preprocessing: networks,
    }
