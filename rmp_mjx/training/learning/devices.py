"""Environments spread over devices; every device has the networks.

A mesh has one axis, `AXIS`. Arrays with a row for each environment are split along it.
Roll-outs run separately on each device (`per_device`). The rest is one program over all
of the data, which the compiler divides, sums of gradients included.
"""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from rmp_mjx.training.config import ConfigError
from rmp_mjx.trees import numbers

AXIS = "envs"
LIMITS = ("memory.max", "memory/memory.limit_in_bytes")
"""Where Linux says how much memory a container may use, below /sys/fs/cgroup."""


def make_mesh(groups: int, wanted: int | None = None) -> Mesh:
    """A mesh of the devices that share the groups of environments equally.

    Args:
        groups: Number of groups of environments; every device gets as many.
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
    """As `make_mesh`, with the devices of this process only."""
    devices = jax.local_devices()
    return Mesh(np.array(devices[: _shares(groups, len(devices))]), (AXIS,))


def _shares(groups: int, most: int) -> int:
    """The largest number of equal shares, at most so many."""
    return max(n for n in range(1, most + 1) if groups % n == 0)


def spec(axis: int | None) -> PartitionSpec:
    """Split along an array's `axis`; None: a copy on every device."""
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, AXIS)


def placed(mesh: Mesh, axis: int | None) -> NamedSharding:
    """Placement of an array on the mesh; see `spec`."""
    return NamedSharding(mesh, spec(axis))


def per_device(
    function: Callable[..., Any], mesh: Mesh, in_axes: Any, out_axes: Any
) -> Callable[..., Any]:
    """Run a function on each device, with the rows of that device.

    The compiler cannot divide a simulator behind a host callback; this does.

    Args:
        function: Takes and returns trees of arrays; it must process each row
            independently.
        mesh: The devices.
        in_axes: For each argument, the axis of its rows; None if it has none. One
            axis may stand for all leaves of a tree.
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


def size(tree: Any) -> int:
    """Bytes of a tree of arrays, or of shapes."""
    leaves = jax.tree.leaves(jax.eval_shape(numbers, tree))
    return sum(leaf.size * leaf.dtype.itemsize for leaf in leaves)


def memory(devices: Sequence[Any]) -> int:
    """Bytes of the devices' own memory; of the machine's if they have none."""
    own = [(device.memory_stats() or {}).get("bytes_limit", 0) for device in devices]
    if all(own):
        return sum(own)
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    limits = (Path("/sys/fs/cgroup", name) for name in LIMITS)
    found = (path.read_text().strip() for path in limits if path.exists())
    return min([machine, *(int(text) for text in found if text.isdecimal())])


def check_memory(needed: int, devices: Sequence[Any], names: str) -> None:
    """Refuse a program that cannot fit.

    Args:
        needed: Bytes that it needs at least.
        devices: What it runs on.
        names: Options that decide how much it needs, in words.

    Raises:
        ConfigError: There is less memory; the message has both figures.
    """
    most = memory(devices)
    if needed > most:
        raise ConfigError(
            f"this needs at least {needed / 2**30:,.1f} GiB of memory, and there are "
            f"{most / 2**30:,.1f}: lower {names}"
        )
