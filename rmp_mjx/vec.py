"""Struct-of-arrays 3-vectors: one array per component.

The tree does the same arithmetic for every control point and obstacle. With one
array per component each operation is a long elementwise loop that vectorises on a
CPU and fuses on an accelerator; an array with a trailing axis of 3 does neither.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from rmp_mjx.pytree import Constant, Pytree


class Vec(Pytree):
    """A 3-vector field; the components have one shape, or broadcast."""

    x: Constant
    """First component."""
    y: Constant
    """Second component."""
    z: Constant
    """Third component."""

    @classmethod
    def of(cls, array: ArrayLike, axis: int = -1) -> Vec:
        """Split an array along an axis of length 3."""
        array = jnp.moveaxis(jnp.asarray(array), axis, 0)
        return cls(array[0], array[1], array[2])

    @classmethod
    def column(cls, array: ArrayLike) -> Vec:
        """Split an array (o, 3) into components (o, 1), to broadcast over points."""
        array = jnp.asarray(array)
        return cls(array[:, 0:1], array[:, 1:2], array[:, 2:3])

    def stack(self, axis: int = 0) -> Array:
        """Join the components into one array along a new axis."""
        return jnp.stack(jnp.broadcast_arrays(self.x, self.y, self.z), axis)

    def map(self, fn: Callable[..., Array], *others: Vec) -> Vec:
        """Apply a function to each component (and the others' same component)."""
        return Vec(
            fn(self.x, *(o.x for o in others)),
            fn(self.y, *(o.y for o in others)),
            fn(self.z, *(o.z for o in others)),
        )

    def __add__(self, other: Vec) -> Vec:
        """Sum."""
        return Vec(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: Vec) -> Vec:
        """Difference."""
        return Vec(self.x - other.x, self.y - other.y, self.z - other.z)

    def __mul__(self, s: Array | float) -> Vec:
        """Product with a scalar field."""
        return Vec(self.x * s, self.y * s, self.z * s)

    def __matmul__(self, other: Vec) -> Array:
        """Scalar product."""
        return self.x * other.x + self.y * other.y + self.z * other.z

    def cross(self, other: Vec) -> Vec:
        """Vector product."""
        return Vec(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )


def xyz(v: Vec) -> tuple[Array, Array, Array]:
    """The components, to unpack or to iterate over."""
    return v.x, v.y, v.z
