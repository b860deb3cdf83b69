"""What is materialised is the same array."""

import jax
import jax.numpy as jnp
import numpy as np

from rmp_mjx.xla import materialize

RNG = np.random.default_rng(0)
A, B = (RNG.normal(size=(5, 3)).astype(np.float32) for _ in range(2))


def test_a_materialised_array_is_the_same_array_with_the_same_gradient():
    np.testing.assert_array_equal(materialize(jnp.asarray(A)), A)
    gradient = jax.grad(lambda x: jnp.sum(materialize(x) * B))(jnp.asarray(A))
    np.testing.assert_array_equal(gradient, B)
    assert jax.vmap(materialize)(jnp.asarray(A)).shape == A.shape
