"""Statistics of the transitions that count: those with weight 1, not 0."""

import jax.numpy as jnp
from jaxtyping import Array, Float

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
