"""PPO's losses (Schulman et al., 2017), and weighted means of transitions."""

from typing import Any

import jax.numpy as jnp
from brax.training.agents.ppo.networks import PPONetworks
from jaxtyping import Array, Float

from rmp_mjx.pytree import Pytree
from rmp_mjx.training.learning.networks import distribution

SMALLEST = 1e-8
"""Added to what is divided by."""


def weighted_mean(
    x: Float[Array, "*b"], weight: Float[Array, "*b"]
) -> Float[Array, ""]:
    """Mean of the entries with weight 1; 0 if there are none."""
    return jnp.sum(x * weight) / jnp.maximum(jnp.sum(weight), 1.0)


def standardized(
    x: Float[Array, "*b"], weight: Float[Array, "*b"]
) -> Float[Array, "*b"]:
    """Shift and scale to mean 0 and deviation 1 over the entries with weight 1."""
    mean = weighted_mean(x, weight)
    variance = weighted_mean((x - mean) ** 2, weight)
    return (x - mean) / (jnp.sqrt(variance) + SMALLEST)


def explained_variance(
    targets: Float[Array, "*b"],
    errors: Float[Array, "*b"],
    weight: Float[Array, "*b"],
) -> Float[Array, ""]:
    """Share of the targets' variance that the values explain; 1 is perfect."""
    mean = weighted_mean(targets, weight)
    spread = weighted_mean((targets - mean) ** 2, weight)
    return 1.0 - weighted_mean(errors**2, weight) / (spread + SMALLEST)


class Batch(Pytree):
    """A minibatch, (b, ...)."""

    obs: Float[Array, "b n"]
    """Observations."""
    raw_action: Float[Array, "b m"]
    """Actions before clipping."""
    log_prob: Float[Array, " b"]
    """Log density under the acting policy."""
    advantage: Float[Array, " b"]
    """Normalised advantages."""
    target: Float[Array, " b"]
    """Normalised value targets."""
    weight: Float[Array, " b"]
    """0 leaves a transition out."""


def ppo_loss(
    params: tuple[Any, Any],
    normalizer: Any,
    batch: Batch,
    networks: PPONetworks,
    clipping_epsilon: float,
    entropy_cost: float,
    vf_coefficient: float,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Clipped surrogate, value error and entropy bonus.

    Args:
        params: Parameters of the policy and of the value network.
        normalizer: Observation statistics.
        batch: Minibatch.
        networks: The networks.
        clipping_epsilon: Clip range of the probability ratio.
        entropy_cost: Weight of the entropy bonus.
        vf_coefficient: Weight of the value loss.

    Returns:
        The loss and its parts.
    """
    policy_params, value_params = params
    logits = networks.policy_network.apply(normalizer, policy_params, batch.obs)
    values = networks.value_network.apply(normalizer, value_params, batch.obs)

    actions = networks.parametric_action_distribution
    log_ratio = actions.log_prob(logits, batch.raw_action) - batch.log_prob
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - clipping_epsilon, 1.0 + clipping_epsilon)
    surrogate = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)
    policy_loss = -weighted_mean(surrogate, batch.weight)
    entropy = weighted_mean(
        distribution(networks, logits).entropy().sum(-1), batch.weight
    )
    error = weighted_mean((batch.target - values) ** 2, batch.weight)
    value_loss = 0.5 * vf_coefficient * error
    loss = policy_loss + value_loss - entropy_cost * entropy
    return loss, {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "entropy": entropy,
        # Schulman's estimator of KL(old, new): non-negative, low variance
        "kl": weighted_mean(ratio - 1.0 - log_ratio, batch.weight),
        "clip_fraction": weighted_mean(
            (jnp.abs(ratio - 1.0) > clipping_epsilon).astype(jnp.float32),
            batch.weight,
        ),
    }
