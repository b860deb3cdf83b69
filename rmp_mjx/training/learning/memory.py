"""The memory that a program needs at least, known before it is compiled."""

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax

from rmp_mjx.training.config import ConfigError, PPOConfig
from rmp_mjx.training.learning import seeds
from rmp_mjx.trees import numbers

LIMITS = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)
"""Where Linux says how much memory a container may use, in its two versions."""


def size(tree: Any) -> int:
    """Bytes of a tree of arrays, or of shapes."""
    leaves = jax.tree.leaves(jax.eval_shape(numbers, tree))
    return sum(leaf.size * leaf.dtype.itemsize for leaf in leaves)


def available(devices: Sequence[Any]) -> int:
    """Bytes of the devices' own memory; of the machine's if they have none."""
    own = [(device.memory_stats() or {}).get("bytes_limit") for device in devices]
    if all(own):
        return sum(bytes_ for bytes_ in own if bytes_)
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    found = (path.read_text().strip() for path in LIMITS if path.exists())
    return min([machine, *(int(text) for text in found if text.isdecimal())])


def check(needed: int, devices: Sequence[Any], names: str) -> None:
    """Refuse a program that cannot fit.

    Args:
        needed: Bytes that it needs at least.
        devices: What it runs on.
        names: Options that decide how much it needs, in words.

    Raises:
        ConfigError: There is less memory; the message has both figures.
    """
    most = available(devices)
    if needed > most:
        raise ConfigError(
            f"this needs at least {needed / 2**30:,.1f} GiB of memory, and there are "
            f"{most / 2**30:,.1f}: lower {names}"
        )


def check_training(programs: seeds.Programs, config: PPOConfig) -> None:
    """Refuse a training that cannot fit: its state, and its data twice.

    The data is there once as it was gathered and once in the order of the groups.
    Tracing takes what the first iteration would take for it anyway.

    Args:
        programs: The training.
        config: Its options.

    Raises:
        ConfigError: There is less memory.
    """
    keys = jax.eval_shape(partial(seeds.keys, config))
    state = jax.eval_shape(programs.init, keys)
    _, data, _ = jax.eval_shape(programs.gather, state)
    devices = [
        device
        for device in programs.mesh.devices.flat
        if device.process_index == jax.process_index()
    ]
    share = len(devices) / programs.mesh.devices.size
    names = "num_envs, unroll_length, num_seeds or hidden_sizes"
    check(int(share * (size(state) + 2 * size(data))), devices, names)
