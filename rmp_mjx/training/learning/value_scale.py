"""Adaptive scale of the value function's targets (PopArt)."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.pytree import Pytree
from rmp_mjx.training.learning.loss import weighted_mean

SLOWEST_RATE = 0.05
"""Weight of an iteration's targets in the running moments, once many have passed."""
MIN_STD = 1e-2
"""Floor on the deviation, for tasks whose returns are constant."""


class ValueScale(Pytree):
    """Running moments of the value targets; V = mean + std * network."""

    mean: Float[Array, ""]
    """Mean target."""
    square: Float[Array, ""]
    """Mean squared distance from the mean."""
    rate: Float[Array, ""]
    """Weight that the next iteration gets."""

    @property
    def std(self) -> Float[Array, ""]:
        """Deviation of the targets, floored."""
        return jnp.maximum(jnp.sqrt(self.square), MIN_STD)

    def normalise(self, values: Float[Array, "*b"]) -> Float[Array, "*b"]:
        """Returns to the network's units."""
        return (values - self.mean) / self.std

    def restore(self, outputs: Float[Array, "*b"]) -> Float[Array, "*b"]:
        """The network's units to returns."""
        return outputs * self.std + self.mean


def init() -> ValueScale:
    """The identity scale; the first update replaces it altogether."""
    one = jnp.float32(1.0)
    return ValueScale(mean=jnp.float32(0.0), square=one, rate=one)


def update(
    scale: ValueScale, targets: Float[Array, "*b"], weight: Float[Array, "*b"]
) -> ValueScale:
    """Move the moments towards those of new targets."""
    mean = weighted_mean(targets, weight)
    square = weighted_mean((targets - mean) ** 2, weight)
    rate, step = scale.rate, mean - scale.mean
    return ValueScale(
        mean=scale.mean + rate * step,
        square=(1 - rate) * (scale.square + rate * step**2) + rate * square,
        rate=jnp.maximum(rate / (1.0 + rate), SLOWEST_RATE),
    )


def rescale_output(params: Any, old: ValueScale, new: ValueScale) -> Any:
    """Rewrite the value network's last layer so that its values stay the same.

    van Hasselt et al., "Learning values across many orders of magnitude" (2016),
    equation 5.

    Args:
        params: Parameters of a Brax MLP, layers `hidden_0`, `hidden_1`, ...
        old: Scale that the parameters belong to.
        new: Scale that they shall belong to.

    Returns:
        Parameters whose restored values under `new` equal the old ones.
    """
    layers = params["params"]
    last = f"hidden_{len(layers) - 1}"
    ratio = old.std / new.std
    layer = {
        "kernel": layers[last]["kernel"] * ratio,
        "bias": layers[last]["bias"] * ratio + (old.mean - new.mean) / new.std,
    }
    return {**params, "params": {**layers, last: layer}}
