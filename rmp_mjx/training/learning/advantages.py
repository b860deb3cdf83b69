"""Generalised advantages, exact at time limits, and the batch made of them."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.learning import value_scale
from rmp_mjx.training.learning.loss import (
    Batch,
    explained_variance,
    standardized,
    weighted_mean,
)
from rmp_mjx.training.learning.rollout import Transition
from rmp_mjx.training.learning.value_scale import ValueScale


def generalised_advantages(
    data: Transition,
    values: Float[Array, "t b"],
    next_values: Float[Array, "t b"],
    discounting: float,
    gae_lambda: float,
) -> Float[Array, "t b"]:
    r"""Advantages of Schulman et al. (2016), equation 16.

    $$
    A_t = \delta_t + \gamma\lambda (1 - d_t) A_{t+1}, \quad
    \delta_t = r_t + \gamma (1 - e_t) V(o'_t) - V(o_t)
    $$

    with $e$ the terminations, $d$ terminations and truncations, and
    $o'$ the observation before a reset: a time limit is not an end.

    Args:
        data: Transitions, (t, b).
        values: V of `data.obs`.
        next_values: V of `data.next_obs`.
        discounting: Discount per step.
        gae_lambda: Lambda.

    Returns:
        Advantages, 0 where the weight is 0; the value targets are their sum with
        `values`.
    """
    delta = data.reward + discounting * (1.0 - data.termination) * next_values - values
    continues = (1.0 - data.termination) * (1.0 - data.truncation)

    def backward(later, step):
        delta, continues, weight = step
        advantage = weight * (delta + discounting * gae_lambda * continues * later)
        return advantage, advantage

    _, advantages = jax.lax.scan(
        backward,
        jnp.zeros_like(values[0]),
        (delta, continues, data.weight),
        reverse=True,
    )
    return advantages


Metrics = dict[str, Float[Array, ""]]
"""Numbers of the learner by name."""


def make_batch(
    config: PPOConfig,
    data: Transition,
    values: Float[Array, "t b"],
    next_values: Float[Array, "t b"],
    scale: ValueScale,
) -> tuple[Batch, ValueScale, Metrics]:
    """Turn transitions into what the losses need.

    Args:
        config: PPO's options.
        data: Transitions, (t, b).
        values: Value of `data.obs`, in units of the reward.
        next_values: Value of `data.next_obs`.
        scale: Scale of the value targets so far.

    Returns:
        The batch, (t, b), its targets in units of the new scale; the new scale; how
        good the values were.
    """
    advantages = generalised_advantages(
        data, values, next_values, config.discounting, config.gae_lambda
    )
    targets = values + advantages
    scale = value_scale.update(scale, targets, data.weight)
    batch = Batch(
        obs=data.obs,
        raw_action=data.raw_action,
        log_prob=data.log_prob,
        advantage=standardized(advantages, data.weight),
        target=scale.normalise(targets),
        weight=data.weight,
    )
    metrics = {
        "explained_variance": explained_variance(targets, advantages, data.weight),
        "value_mean": weighted_mean(values, data.weight),
        "value_scale": scale.std,
    }
    return batch, scale, metrics
