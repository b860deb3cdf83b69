"""Pytrees of arrays some of whose leaves are typed random keys."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool


def is_key(leaf: Any) -> bool:
    """Whether a leaf (or its shape) is an array of typed random keys."""
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def numbers(tree: Any) -> Any:
    """The tree with every random key as its data, uint32 of shape (..., words)."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if is_key(x) else x, tree)


def like(data: Array, leaf: Any) -> Array:
    """The inverse of `numbers` for one leaf: a key again where `leaf` is one."""
    return jax.random.wrap_key_data(data) if is_key(leaf) else data


def named_leaves(tree: Any) -> dict[str, Any]:
    """Leaves of a tree by their paths in it, as `jax.tree_util.keystr` writes them."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}


def cast_like(tree: Any, reference: Any) -> Any:
    """Give every leaf the dtype of its reference, strongly typed; keys stay.

    A state with weakly typed leaves makes `jax.jit` compile a step twice: once for the
    first state, once for the states that steps return.
    """

    def cast(x, ref):
        return x if is_key(ref) else jax.lax.convert_element_type(x, ref.dtype)

    return jax.tree.map(cast, tree, reference)


def select(mask: Bool[Array, " b"], new: Any, old: Any) -> Any:
    """Take `new` where the mask holds, `old` elsewhere, leaf by leaf.

    Args:
        mask: One entry for each row of the leaves.
        new: Tree of arrays (b, ...).
        old: Tree of the same structure and shapes.
    """

    def pick(n, o):
        return jnp.where(mask.reshape(mask.shape + (1,) * (o.ndim - 1)), n, o)

    return jax.tree.map(pick, new, old)
