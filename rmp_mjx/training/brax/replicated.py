"""`jax.device_put_replicated`, which JAX removed and Brax 0.14.2 calls."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

NAME = "device_put_replicated"
BRAX_AXIS = "i"
"""Name of the devices' axis in Brax. JAX compiles a program again for an argument that
lies on an axis of another name."""


def put_replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """Copy a tree to several devices, as `jax.pmap` takes it.

    Args:
        tree: Pytree of arrays or numbers, shape s each.
        devices: The d devices.

    Returns:
        The same tree with arrays of shape (d, *s), one slice a device.
    """
    mesh = Mesh(np.array(devices), (BRAX_AXIS,))
    placed = NamedSharding(mesh, PartitionSpec(BRAX_AXIS))

    def put(leaf):
        leaf = jnp.asarray(leaf)
        copies = jnp.broadcast_to(leaf, (len(devices), *leaf.shape))
        return jax.device_put(copies, placed)

    return jax.tree.map(put, tree)


@contextmanager
def device_put_replicated() -> Iterator[None]:
    """Give `jax.device_put_replicated` to a JAX that has none, inside the context."""
    if hasattr(jax, NAME):
        yield
        return
    setattr(jax, NAME, put_replicated)
    try:
        yield
    finally:
        delattr(jax, NAME)
