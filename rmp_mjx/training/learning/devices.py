"""Environments spread over devices, the networks on every one of them.

A mesh has one axis, `AXIS`, along which whatever has a row for each environment is cut.
Roll-outs run apart on each piece (`per_device`); the rest is one program over all of
the data, which the compiler divides, gradients summed up included.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from rmp_mjx.training.config import ConfigError

AXIS = "envs"


def make_mesh(groups: int, wanted: int | None = None) -> Mesh:
    """A mesh of the devices that share the groups of environments equally.

    Args:
        groups: Groups of environments; their number is a multiple of the devices'.
        wanted: At most this many devices; None: all.

    Returns:
        The mesh, of the largest number of devices that divides the groups.

    Raises:
        ConfigError: Several processes could not take part in equal shares.
    """
    devices = jax.devices()
    count = _shares(groups, min(len(devices), wanted or len(devices)))
    if jax.process_count() > 1 and count < len(devices):
        raise ConfigError(
            f"{jax.process_count()} processes have {len(devices)} devices, which do "
            f"not share {groups} groups of environments equally: see num_groups"
        )
    return Mesh(np.array(devices[:count]), (AXIS,))


def local_mesh(groups: int) -> Mesh:
    """As `make_mesh`, of this process's devices alone."""
    devices = jax.local_devices()
    return Mesh(np.array(devices[: _shares(groups, len(devices))]), (AXIS,))


def _shares(groups: int, most: int) -> int:
    """The largest number of equal shares, at most so many."""
    return max(n for n in range(1, most + 1) if groups % n == 0)


def spec(axis: int | None) -> PartitionSpec:
    """Cut along an array's `axis`; None: whole on every device."""
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, AXIS)


def placed(mesh: Mesh, axis: int | None) -> NamedSharding:
    """How an array lies on the mesh: cut along `axis`, or (None) whole everywhere."""
    return NamedSharding(mesh, spec(axis))


def per_device(
    function: Callable[..., Any], mesh: Mesh, in_axes: Any, out_axes: Any
) -> Callable[..., Any]:
    """Run a function on each device, on its own rows alone.

    The compiler cannot divide what it cannot see into, such as a simulator behind a
    host callback; this divides by hand.

    Args:
        function: Takes and returns trees of arrays; it treats rows alike and apart.
        mesh: The devices.
        in_axes: For each argument, the axis of its rows; None where it has none. A
            tree may stand in for all of its leaves.
        out_axes: The same for the results.

    Returns:
        The function over all rows.
    """
    specs = [
        jax.tree.map(spec, axes, is_leaf=lambda x: x is None)
        for axes in (in_axes, out_axes)
    ]
    return jax.shard_map(
        function, mesh=mesh, in_specs=specs[0], out_specs=specs[1], check_vma=False
    )
