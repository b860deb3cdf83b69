"""A hint to XLA on a CPU, so that small matrices are computed once."""

import jax
import jax.numpy as jnp
from jax import Array


def materialize(x: Array) -> Array:
    """The same array, computed once and stored instead of recomputed by its users.

    XLA's CPU backend fuses whatever leads to a small matrix into every element of
    every consumer. An `optimization_barrier` keeps a chain of links apart, but does not
    stop this. A reduction of two operands ends the fusion and is not simplified away.
    """
    padded = jnp.stack([x, jnp.zeros_like(x)])
    zero = jnp.zeros((), x.dtype)

    def add(a: tuple[Array, Array], b: tuple[Array, Array]) -> tuple[Array, Array]:
        return a[0] + b[0], a[1] + b[1]

    return jax.lax.reduce((padded, padded), (zero, zero), add, (0,))[0]
