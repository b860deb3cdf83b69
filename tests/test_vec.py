"""Component-wise vectors against plain arrays."""

import jax.numpy as jnp
import numpy as np

from rmp_mjx.vec import Vec

RNG = np.random.default_rng(0)
A, B = (RNG.normal(size=(5, 3)).astype(np.float32) for _ in range(2))


def test_arithmetic_is_that_of_arrays():
    """1e-6: a few float32 roundings of numbers of order one."""
    a, b = Vec.of(A), Vec.of(B)
    for ours, expected in (
        (a + b, A + B),
        (a - b, A - B),
        (a * 2.5, A * 2.5),
        (a.cross(b), np.cross(A, B)),
        (a.map(jnp.maximum, b), np.maximum(A, B)),
    ):
        np.testing.assert_allclose(ours.stack(-1), expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(a @ b, np.sum(A * B, axis=1), rtol=1e-5, atol=1e-6)


def test_split_and_stack_are_inverse_along_any_axis():
    for axis in (0, 1, -1):
        x = RNG.normal(size=(3, 3))
        np.testing.assert_array_equal(Vec.of(x, axis).stack(axis), np.float32(x))


def test_columns_broadcast_over_points():
    difference = Vec.of(A[None]) - Vec.column(B[:2])
    np.testing.assert_allclose(difference.stack(-1), A[None] - B[:2, None], rtol=1e-6)


def test_stack_broadcasts_components():
    assert Vec(jnp.zeros(4), jnp.zeros(()), jnp.ones((2, 1))).stack().shape == (3, 2, 4)
