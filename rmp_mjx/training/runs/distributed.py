"""Several processes that train one run together: joining, and shared decisions.

Every process runs the same program on its own part of the environments. Process 0, the
primary, prints and writes.
"""

import os
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh

from rmp_mjx.training.config import ConfigError, TrainConfig
from rmp_mjx.training.learning import devices
from rmp_mjx.training.runs import run_folder

TEXT_SIZE = 4096
"""Bytes of a text that the primary sends to the others."""


def join(
    coordinator: str | None, process_id: int | None, num_processes: int | None
) -> None:
    """Join the other processes, if there are any, before JAX opens its backend.

    Args:
        coordinator: HOST:PORT of process 0, which listens on this address and on no
            other. None: taken from Slurm (`srun` with more
            than one task), else this process is alone.
        process_id: Number of this process.
        num_processes: Number of processes.

    Raises:
        ConfigError: The three contradict each other.
    """
    if coordinator is None and not _under_slurm():
        if process_id is not None or num_processes is not None:
            raise ConfigError("process_id and num_processes need --coordinator")
        return
    if coordinator is not None:
        if process_id is None or num_processes is None:
            raise ConfigError("coordinator needs --process_id and --num_processes")
        host, _, port = coordinator.rpartition(":")
        if not (host and port.isdecimal() and 0 < int(port) < 2**16):
            raise ConfigError(f"coordinator must be HOST:PORT, is {coordinator!r}")
        if not 0 <= process_id < num_processes:
            raise ConfigError(
                f"process_id must be in 0 .. {num_processes - 1}, is {process_id}"
            )
    jax.distributed.initialize(
        coordinator, num_processes, process_id, coordinator_bind_address=coordinator
    )


def _under_slurm() -> bool:
    """Whether `srun` started this process as one of several."""
    names = ("SLURM_STEP_NODELIST", "SLURM_PROCID", "SLURM_LOCALID")
    tasks = os.environ.get("SLURM_NTASKS", "1")
    return all(name in os.environ for name in names) and int(tasks) > 1


def alone() -> bool:
    """Whether there is no other process; starts no backend."""
    return not jax.distributed.is_initialized()


def is_primary() -> bool:
    """Whether this process writes."""
    return alone() or jax.process_index() == 0


def largest(value: int) -> int:
    """The largest of the processes' values; every process must call it."""
    if alone():
        return value
    return int(np.max(multihost_utils.process_allgather(np.int32(value))))


def from_primary(text: str) -> str:
    """The primary's text; every process must call it."""
    if alone():
        return text
    sent = text.encode()[:TEXT_SIZE].ljust(TEXT_SIZE, b"\0")
    heard = multihost_utils.broadcast_one_to_all(np.frombuffer(sent, np.uint8))
    return bytes(np.asarray(heard)).rstrip(b"\0").decode(errors="ignore")


def open_run(config: TrainConfig) -> tuple[Path, AbstractContextManager]:
    """`run_folder.open_run` by the primary, for all; every process must call it.

    Returns:
        The folder, and its lock (None on the other processes).

    Raises:
        ConfigError: On every process, if the primary cannot open the folder.
    """
    if alone():
        return run_folder.open_run(config)
    lock, said, error = nullcontext(), "", None
    if is_primary():
        try:
            folder, lock = run_folder.open_run(config)
            said = f"folder {folder}"
        except ConfigError as problem:
            error, said = problem, f"error {problem}"
    kind, _, text = from_primary(said).partition(" ")
    if kind == "error":
        raise error or ConfigError(text)
    return Path(text), lock


def collected(tree: Any, mesh: Mesh) -> Any:
    """Gather arrays that are spread over processes; every process must call it.

    Returns:
        Arrays on the primary's CPU, None elsewhere. If this process is alone, the tree
        itself.
    """
    if alone():
        return tree
    gather = jax.jit(lambda x: x, out_shardings=devices.placed(mesh, None))

    def fetch(x):  # one at a time: the whole of everything may not fit on a device
        whole = gather(x).addressable_data(0)
        return jax.device_put(whole, jax.local_devices(backend="cpu")[0])

    fetched = jax.tree.map(fetch, tree)
    return fetched if is_primary() else None
