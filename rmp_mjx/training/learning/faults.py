"""Steps that became non-finite: kept on the device, written to files for a replay."""

import json
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rmp_mjx.pytree import Pytree
from rmp_mjx.trees import like, named_leaves, numbers

ACTION, ABOUT = "action", "about"
"""Entries of a file in addition to the leaves of the state."""
PLACE = ("iteration", "seed", "lane")
"""What a file says of where its step was."""
UNREADABLE = (
    OSError,
    KeyError,
    IndexError,
    TypeError,
    ValueError,
    RecursionError,
    EOFError,
    zipfile.BadZipFile,
    zlib.error,
)
"""How NumPy, zip and JSON say that a file is damaged or something else."""


class Fault(Pytree):
    """The first step of each environment in an unroll that became non-finite."""

    happened: Bool[Array, "*b"]
    """Whether there was one; if not, the other fields mean nothing."""
    env_state: Any
    """States of the environments before it."""
    action: Float[Array, "*b m"]
    """The actions that led to it."""


def none(env_state: Any, num_envs: int, action_size: int) -> Fault:
    """No fault yet."""
    return Fault(
        happened=jnp.zeros(num_envs, bool),
        env_state=env_state,
        action=jnp.zeros((num_envs, action_size)),
    )


def dump(
    fault: Fault, folder: Path, name: str, about: Mapping[str, Any], most: int
) -> list[Path]:
    """Write the faults of a batch to files, one each.

    Args:
        fault: Faults, (b,).
        folder: Where the files go; it is made.
        name: Beginning of their names.
        about: Further information for the reader, JSON-ready; the lane is added.
        most: At most this many files.

    Returns:
        The files.
    """
    lanes = np.flatnonzero(np.asarray(fault.happened))[:most]
    files = []
    for lane in lanes.tolist():
        one = jax.tree.map(lambda x, lane=lane: x[lane], fault)
        leaves = named_leaves(numbers(one.env_state)).items()
        arrays: dict[str, Any] = {path: np.asarray(leaf) for path, leaf in leaves}
        arrays[ACTION] = np.asarray(one.action)
        arrays[ABOUT] = np.array(json.dumps({**about, "lane": lane}))
        folder.mkdir(parents=True, exist_ok=True)
        files.append(folder / f"{name}-lane{lane}.npz")
        np.savez(files[-1], **arrays)
    return files


def load(path: Path, template: Any) -> tuple[Any, Float[np.ndarray, " m"]]:
    """Read a fault.

    Args:
        path: A file of `dump`.
        template: Shapes of one environment's state.

    Returns:
        The state before the step, and the action.

    Raises:
        ValueError: The file is of another task, or damaged.
    """
    wanted = named_leaves(template)
    try:
        with np.load(path) as stored:
            arrays = {name: stored[name] for name in (ACTION, *wanted)}
    except UNREADABLE as error:
        raise ValueError(f"{path} is damaged, or of another task: {error}") from error
    for name, leaf in wanted.items():
        shape = jax.eval_shape(numbers, leaf).shape
        if arrays[name].shape != shape:
            raise ValueError(
                f"{path} is of another task: {name} has shape {arrays[name].shape}, "
                f"not {shape}"
            )
    leaves = [like(jnp.asarray(arrays[name]), leaf) for name, leaf in wanted.items()]
    return jax.tree.unflatten(jax.tree.structure(template), leaves), arrays[ACTION]


def about(path: Path) -> dict[str, Any]:
    """The information that `dump` stored in a file.

    Raises:
        ValueError: The file was not written by `dump`.
    """
    try:
        with np.load(path) as stored:
            found = json.loads(str(stored[ABOUT]))
        return {name: found[name] for name in ("config", *PLACE)} | found
    except UNREADABLE as error:
        raise ValueError(f"{path} is no dump of a non-finite step: {error}") from error
