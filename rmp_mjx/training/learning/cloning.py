"""Behaviour cloning: a policy that does what demonstrations do (Pomerleau, 1988)."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import optax
from brax.training.acme import running_statistics
from jaxtyping import Array, Float

from rmp_mjx.training.learning.learner import TrainState
from rmp_mjx.training.learning.networks import LOG_STD
from rmp_mjx.training.learning.ppo import MIN_OBS_STD, PPO

STEPS, BATCH, RATE = 4000, 256, 1e-3
"""Gradient steps of Adam, rows of a minibatch, and step size at the start; it falls to
zero as a cosine."""
WEIGHT = 1e6
"""The observations' statistics count as those of so many steps at least: if they moved
faster, the cloned policy would see other numbers than those that it was fitted to."""
LEAST_STD = 0.2
"""Least standard deviation of a cloned policy's actions: PPO learns from what it
tries."""
OWN_KEY = 0x636C6F6E
"""Tells the cloning's randomness from that of the iterations."""


def clone(
    ppo: PPO, state: TrainState, obs: Float[Array, "n o"], action: Float[Array, "n m"]
) -> TrainState:
    """The first state with a policy that imitates, for PPO to go on from.

    The policy's mean is fitted by least squares. Its deviation is what the mean leaves
    unexplained, the likeliest one, between `LEAST_STD` and that of the configuration.
    The statistics of the observations start with those of the demonstrations.

    Args:
        ppo: The training problem.
        state: Its first state.
        obs: Observations of the demonstrations.
        action: What was done then, in [-1, 1].
    """
    obs, action = jnp.asarray(obs), jnp.asarray(action)
    weight = jnp.full(len(obs), max(WEIGHT / len(obs), 1.0))
    normalizer = running_statistics.update(
        state.normalizer, obs, weights=weight, std_min_value=MIN_OBS_STD
    )
    optimizer = optax.adam(optax.cosine_decay_schedule(RATE, STEPS))
    actions = ppo.networks.parametric_action_distribution

    def missed(policy: Any, obs: Array, action: Array) -> Array:
        logits = ppo.networks.policy_network.apply(normalizer, policy, obs)
        return jnp.mean((actions.mode(logits) - action) ** 2, axis=0)

    def step(carry, key):
        policy, opt = carry
        rows = jax.random.randint(key, (BATCH,), 0, len(obs))
        grads = jax.grad(lambda p: missed(p, obs[rows], action[rows]).sum())(policy)
        updates, opt = optimizer.update(grads, opt, policy)
        return (optax.apply_updates(policy, updates), opt), None

    policy = state.learner.policy
    keys = jax.random.split(jax.random.fold_in(state.key, OWN_KEY), STEPS)
    (policy, _), _ = jax.lax.scan(step, (policy, optimizer.init(policy)), keys)
    least = min(math.log(LEAST_STD), ppo.config.init_log_std)
    log_std = 0.5 * jnp.log(missed(policy, obs, action) + 1e-12)
    log_std = jnp.clip(log_std, least, ppo.config.init_log_std)
    policy = jax.tree_util.tree_map_with_path(
        lambda path, leaf: log_std if path[-1].key == LOG_STD else leaf, policy
    )
    return state.replace(
        normalizer=normalizer, learner=state.learner.replace(policy=policy)
    )
