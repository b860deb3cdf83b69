"""Leaf base classes: where a behaviour is defined, in its own coordinate."""

from __future__ import annotations

import abc

import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.pytree import Constant, Pytree
from rmp_mjx.rmp.algebra import RMP

Param = Float[Constant, "..."] | float
"""A leaf's parameter: a number, or an array that broadcasts against the coordinate."""


class Leaf(Pytree, abc.ABC):
    """A motion policy on the coordinate ``x`` of its parent node.

    A leaf is a pytree whose fields are its parameters: array leaves that can be traced,
    vmapped, differentiated and learned. A subclass needs no decorator.
    """

    @abc.abstractmethod
    def __call__(self, x: Float[Array, " m"], xd: Float[Array, " m"]) -> RMP:
        """The leaf's RMP at ``x``, ``xd``: f (m,), M (m, m)."""

    def against(
        self, x: Float[Array, " m"], xd: Float[Array, " m"], push: Float[Array, " m"]
    ) -> RMP:
        """The leaf's RMP where contacts accelerate the coordinate by ``push``, (m,).

        A leaf takes no notice, unless it keeps something safe.
        """
        del push
        return self(x, xd)


class ScalarLeaf(Leaf):
    r"""A leaf that acts on every coordinate separately (diagonal metric).

    The coordinates of a collision leaf are distances, which contacts may shorten. Then
    the leaf asks for its acceleration on top of what they take,

    $$
    f \leftarrow f + m \max(-\ddot x_{contact}, 0) .
    $$

    A leaf whose coordinates are no distances overrides `scalar_against`.
    """

    def braking(self, stop_time: Float[Array, ""] | float) -> ScalarLeaf:
        """The leaf for an arm that needs this time to stop [s].

        A leaf takes no notice, unless it keeps a distance.
        """
        del stop_time
        return self

    def standing_off(self, distance: Float[Array, ""] | float) -> ScalarLeaf:
        """The leaf with a margin that is wider by a distance.

        A leaf takes no notice, unless it has a margin.
        """
        del distance
        return self

    @abc.abstractmethod
    def scalar(
        self, x: Float[Array, "*s"], xd: Float[Array, "*s"]
    ) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
        """Elementwise force ``f = m a`` and metric ``m``, each shaped like ``x``."""

    def __call__(self, x: Float[Array, " m"], xd: Float[Array, " m"]) -> RMP:
        """The same policy as an RMP with metric ``diag(m)``."""
        f, m = self.scalar(x, xd)
        return RMP(f=f, M=jnp.diag(m))

    def scalar_against(
        self, x: Float[Array, "*s"], xd: Float[Array, "*s"], push: Float[Array, "*s"]
    ) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
        """As `scalar`, where contacts accelerate the coordinates by ``push``."""
        f, m = self.scalar(x, xd)
        return f + m * jnp.maximum(-push, 0.0), m

    def against(
        self, x: Float[Array, " m"], xd: Float[Array, " m"], push: Float[Array, " m"]
    ) -> RMP:
        """As `scalar_against`, with metric ``diag(m)``."""
        f, m = self.scalar_against(x, xd, push)
        return RMP(f=f, M=jnp.diag(m))
