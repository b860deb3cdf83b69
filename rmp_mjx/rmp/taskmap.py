"""Task maps: any differentiable function, with Jacobian and curvature by autodiff."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.pytree import Pytree


class TaskMap(Pytree):
    """A differentiable map ``y = fn(x)``, or ``y = fn(params, x)`` with parameters.

    The value may have any shape; it is flattened row by row, so a distance becomes
    (1,) and a rotation matrix (9,). ``params_dot`` makes the map a moving one: it is
    the constant rate of change of ``params`` (an obstacle's velocity, say), and enters
    the child's velocity and curvature.
    """

    fn: Callable[..., Array] = flax.struct.field(pytree_node=False)
    """The function; static, so reuse one function object to avoid retracing."""
    params: Any = None
    """Parameters of the map, any pytree of floats, or None."""
    params_dot: Any = None
    """Their rates [param unit / s], same structure as ``params``; None if fixed."""

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """The child coordinate at ``x``, flattened to (m,)."""
        return self._at(x, self.params)

    def at_time(
        self, x: Float[Array, " n"], t: Float[Array, ""] | float
    ) -> Float[Array, " m"]:
        """The map ``t`` seconds from now: parameters moved by ``t * params_dot``."""
        if self.params_dot is None:
            return self._at(x, self.params)
        moved = jax.tree.map(lambda p, pd: p + t * pd, self.params, self.params_dot)
        return self._at(x, moved)

    def _at(self, x: Array, params: Any) -> Array:
        y = self.fn(x) if self.params is None else self.fn(params, x)
        return jnp.reshape(y, (-1,))


class NodeState(Pytree):
    """State of a child node, with the derivatives that the pullback needs."""

    x: Float[Array, " m"]
    """Child coordinate, (m,)."""
    xd: Float[Array, " m"]
    """Child velocity, (m,), the map's own motion included."""
    J: Float[Array, "m n"]
    """Jacobian with respect to the parent coordinate, (m, n)."""
    Jdot_qd: Float[Array, " m"]
    """Curvature, (m,): the child's acceleration while the parent's is zero."""


def pushforward(
    psi: TaskMap, x: Float[Array, " n"], xd: Float[Array, " n"]
) -> NodeState:
    r"""Push a state through a task map.

    $$
    y = \psi(x, p), \quad \dot y = J \dot x + \partial_p \psi\, \dot p, \quad
    \ddot y = J \ddot x + \tfrac{d^2}{dt^2} \psi(x + t \dot x, p + t \dot p)|_0
    $$

    The last term, ``Jdot_qd``, is a second-order forward derivative (nested jvp). It
    is exact; parameters are taken to move at constant velocity.

    Args:
        psi: Task map.
        x: Parent coordinate, (n,).
        xd: Parent velocity, (n,).

    Returns:
        Child coordinate, velocity, Jacobian and curvature.

    Source: Cheng et al., "RMPflow" (2018), the pushforward operator.
    """
    zero, one = jnp.zeros((), x.dtype), jnp.ones((), x.dtype)

    def velocity(x, t):
        return jax.jvp(psi.at_time, (x, t), (xd, one))

    (y, yd), (_, ydd) = jax.jvp(velocity, (x, zero), (xd, one))
    return NodeState(x=y, xd=yd, J=jax.jacfwd(psi)(x), Jdot_qd=ydd)


def _identity(x: Array) -> Array:
    return x


def identity_map() -> TaskMap:
    """The task map ``y = x``."""
    return TaskMap(fn=_identity)
