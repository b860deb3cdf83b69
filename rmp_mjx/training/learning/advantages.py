"""Generalised advantage estimation with exact bootstrapping at time limits."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.training.learning.rollout import Transition


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
