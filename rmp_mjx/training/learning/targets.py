"""What to learn from transitions: normalized advantages and value targets."""

from jaxtyping import Array, Float

from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.learning import value_scale
from rmp_mjx.training.learning.advantages import generalised_advantages
from rmp_mjx.training.learning.loss import Batch
from rmp_mjx.training.learning.rollout import Transition
from rmp_mjx.training.learning.value_scale import ValueScale
from rmp_mjx.training.learning.weighted import (
    explained_variance,
    standardized,
    weighted_mean,
)

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
