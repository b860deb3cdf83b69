"""The RMP-tree: nodes, homogeneous siblings, and their evaluation."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.pytree import Pytree
from rmp_mjx.rmp.algebra import RMP, pullback
from rmp_mjx.rmp.leaf import Leaf as Leaf
from rmp_mjx.rmp.taskmap import TaskMap, pushforward


class Node(Pytree):
    """An edge of the tree and what hangs on it: ``children`` live on ``psi(x)``."""

    psi: TaskMap
    """Map from the parent's coordinate to this node's."""
    children: tuple[Node | Siblings | Leaf, ...]
    """Subtrees and leaves on this node's coordinate; empty contributes nothing."""


class Siblings(Pytree):
    """K children of one structure, evaluated together by vmap and summed.

    ``child`` is one subtree whose array leaves carry a leading axis K. Scalars (Python
    floats, 0-d arrays) are shared by all K. Siblings may be nested.
    """

    child: Node | Leaf
    """The stacked subtree."""

    @classmethod
    def stack(cls, children: Sequence[Node | Leaf]) -> Siblings:
        """Stack subtrees of equal structure and shapes.

        Raises:
            ValueError: If there are none, or their structures differ.
        """
        if not children:
            raise ValueError("Siblings.stack needs at least one child")
        return cls(jax.tree.map(lambda *leaves: jnp.stack(leaves), *children))


def evaluate(
    node: Node | Siblings | Leaf,
    x: Float[Array, " n"],
    xd: Float[Array, " n"],
    push: Float[Array, " n"] | None = None,
) -> RMP:
    """Evaluate a tree: push states to the leaves, pull their policies back and add.

    Args:
        node: A tree, or any part of one.
        x: Coordinate of the node's parent (of the root: q), (n,).
        xd: Its velocity, (n,).
        push: Its acceleration by contacts, (n,); None: nothing touches.

    Returns:
        The RMP on the parent's coordinate; f (n,), M (n, n). Feed the root's to
        `rmp_mjx.rmp.algebra.resolve`.

    Source: Cheng et al., "RMPflow" (2018), section on the RMP-tree.
    """
    if isinstance(node, Siblings):
        axes = jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) else None, node.child)
        if all(axis is None for axis in jax.tree.leaves(axes, is_leaf=_is_none)):
            raise ValueError("Siblings: no array in the child carries a leading axis")
        along = jax.vmap(evaluate, in_axes=(axes, None, None, None))
        stacked = along(node.child, x, xd, push)
        return jax.tree.map(lambda leaf: jnp.sum(leaf, axis=0), stacked)
    if isinstance(node, Node):
        if not node.children:
            return RMP.zero(x.shape[0], x.dtype)
        pushed = pushforward(node.psi, x, xd)
        if push is not None:
            push = jnp.matmul(pushed.J, push, precision="highest")
        rmps = [evaluate(child, pushed.x, pushed.xd, push) for child in node.children]
        return pullback(functools.reduce(operator.add, rmps), pushed.J, pushed.Jdot_qd)
    return node(x, xd) if push is None else node.against(x, xd, push)


def _is_none(axis: object) -> bool:
    return axis is None
