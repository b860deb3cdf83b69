"""Checkpoints: atomic, verified, complete.

A checkpoint is a flat set of arrays written by Orbax (temporary folder, then a
rename), beside a manifest with every array's path, shape, dtype and SHA-256: Orbax
itself neither detects a flipped bit nor refuses another dtype. Zero-size arrays,
which Orbax cannot store, come from the template; PRNG keys are stored as their data.
"""

import contextlib
import hashlib
import json
import logging
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers as retention

from rmp_mjx.trees import like, named_leaves, numbers

NEWEST, BEST = "newest", "best"
"""Checkpoints that have a name besides their number."""
MERITS = ("success", "return")
"""Means over recent episodes that rank checkpoints; the first counts most."""


class CheckpointError(RuntimeError):
    """No usable checkpoint; the message says why."""


class CheckpointMismatch(CheckpointError):
    """The checkpoint belongs to another configuration or task."""


class SaveError(CheckpointError):
    """A checkpoint could not be written; those before it are untouched."""


def _describe(path: str, array: np.ndarray) -> dict[str, Any]:
    return {
        "path": path,
        "shape": list(array.shape),
        "dtype": str(array.dtype),
        "sha256": hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest(),
    }


def _digest(arrays: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(arrays, sort_keys=True).encode()).hexdigest()


def _rank(merit: Mapping[str, float]) -> tuple[float, ...]:
    return tuple(merit[name] for name in MERITS)


class Checkpointer:
    """The checkpoints of one run folder."""

    def __init__(
        self,
        folder: Path,
        keep: int = 3,
        keep_every: int = 0,
        read_only: bool = False,
    ):
        """Open a folder of checkpoints.

        Args:
            folder: The folder; created unless `read_only`.
            keep: Newest checkpoints that are kept; so is the best one.
            keep_every: Checkpoints at multiples of this are kept too; 0: none.
            read_only: Do not create or clean up anything.
        """
        for name in ("absl", "orbax"):  # they narrate every save at INFO and WARNING
            logging.getLogger(name).setLevel(logging.ERROR)
        self._folder = folder.absolute()
        self._read_only = read_only
        if read_only and not self._folder.is_dir():
            raise CheckpointError(f"no checkpoints in {folder}")
        if not read_only:
            self._folder.mkdir(parents=True, exist_ok=True)
        kept = [
            retention.LatestN(keep),
            retention.BestN(
                get_metric_fn=_rank,  # pyright: ignore[reportArgumentType]
                n=1,
                keep_checkpoints_without_metrics=False,
            ),
        ]
        if keep_every:
            kept.append(retention.EveryNSteps(keep_every))
        self._options = ocp.CheckpointManagerOptions(
            preservation_policy=retention.AnyPreservationPolicy(kept),
            best_fn=_rank,  # pyright: ignore[reportArgumentType]
            enable_async_checkpointing=False,
            create=False,
            read_only=read_only,
            # each process alone: Orbax would wait for the others otherwise
            multiprocessing_options=ocp.options.MultiprocessingOptions(
                primary_host=jax.process_index(),
                active_processes={jax.process_index()},
            ),
        )
        self._manager = self._open()

    def _open(self) -> ocp.CheckpointManager:
        if not self._read_only:  # Orbax's own cleaning outlives a closed manager
            for half in self._folder.glob("*.orbax-checkpoint-tmp*"):
                shutil.rmtree(half, ignore_errors=True)
        return ocp.CheckpointManager(self._folder, options=self._options)

    def save(
        self, step: int, state: Any, merit: Mapping[str, float] | None = None
    ) -> None:
        """Write a checkpoint; when this returns it is complete.

        Args:
            step: Its number, larger than all before.
            state: Any pytree of arrays.
            merit: Values that rank it, by `MERITS`; None: unknown.

        Raises:
            SaveError: It could not be written, for instance because the disk is full.
                Its temporary files are removed; earlier ones are untouched.
        """
        arrays, manifest = {}, {}
        for index, (path, leaf) in enumerate(named_leaves(state).items()):
            array = np.asarray(jax.device_get(numbers(leaf)))
            if array.size:
                name = f"{index:05d}"
                arrays[name] = array
                manifest[name] = _describe(path, array)
        try:
            self._manager.save(
                step,
                args=ocp.args.Composite(
                    state=ocp.args.StandardSave(arrays),
                    manifest=ocp.args.JsonSave(
                        {"arrays": manifest, "sha256": _digest(manifest)}
                    ),
                ),
                metrics=dict(merit) if merit else None,
            )
            self._manager.wait_until_finished()
        except Exception as error:  # Orbax's errors share no base class
            with contextlib.suppress(Exception):
                self._manager.close()
            self._manager = self._open()  # removes what is half written
            raise SaveError(f"checkpoint {step}: {_reason(error)}") from error

    def restore(
        self, template: Any, note: Callable[[str], None], which: str = NEWEST
    ) -> tuple[int, Any]:
        """Read the newest sound checkpoint, or another one.

        Args:
            template: Pytree of arrays or shapes that the result will look like; parts
                that are None are not read.
            note: Called with one line for each checkpoint that had to be skipped.
            which: `newest`, `best`, or a number. If the newest is damaged, the one
                before it is read instead.

        Returns:
            Step number and the state.

        Raises:
            CheckpointMismatch: Arrays are missing or have other shapes or dtypes.
            CheckpointError: There is no sound checkpoint.
        """
        steps = self.steps
        if which != NEWEST:
            step = self._choose(which, steps)
            try:
                return step, _fill(template, self._read(step))
            except CheckpointMismatch:
                raise
            except Exception as error:
                raise CheckpointError(
                    f"checkpoint {step} is damaged: {_reason(error)}"
                ) from error
        damaged = []
        for step in steps:
            try:
                stored = self._read(step)
            except Exception as error:  # Orbax's errors share no base class
                note(
                    f"checkpoint {step} is damaged, trying an older one: "
                    f"{_reason(error)}"
                )
                damaged.append(step)
            else:
                state = _fill(template, stored)
                for old in () if self._read_only else damaged:
                    self._manager.delete(old)  # its number will be needed again
                return step, state
        raise CheckpointError(f"no usable checkpoint in {self._folder}")

    @property
    def steps(self) -> list[int]:
        """Numbers of the checkpoints, sound or not, the newest first."""
        return sorted(self._manager.all_steps(read=True), reverse=True)

    def _choose(self, which: str, steps: list[int]) -> int:
        """The step of the best checkpoint, or of the one with this number."""
        if which == BEST:
            merits = ((self._manager.metrics(step), step) for step in steps)
            ranked = [(_rank(merit), step) for merit, step in merits if merit]
            if ranked:
                return max(ranked)[1]
        elif which.isdecimal() and int(which) in steps:
            return int(which)
        have = ", ".join(map(str, steps[::-1])) or "none"
        raise CheckpointError(
            f"no checkpoint {which!r} in {self._folder}; there are: {have}"
        )

    def _read(self, step: int) -> dict[str, np.ndarray]:
        """Arrays by path, every one verified."""
        manifest = self._manager.restore(
            step,
            args=ocp.args.Composite(manifest=ocp.args.JsonRestore()),
        )["manifest"]
        if _digest(manifest["arrays"]) != manifest["sha256"]:
            raise CheckpointError("the manifest fails its checksum")
        manifest = manifest["arrays"]
        shapes = {
            name: np.zeros(entry["shape"], entry["dtype"])
            for name, entry in manifest.items()
        }
        arrays = self._manager.restore(
            step,
            args=ocp.args.Composite(
                state=ocp.args.StandardRestore(shapes)
            ),
        )["state"]
        stored = {}
        for name, entry in manifest.items():
            array = np.asarray(arrays[name])
            if _describe(entry["path"], array) != entry:
                raise CheckpointError(f"{entry['path']} fails its checksum")
            stored[entry["path"]] = array
        return stored

    def close(self) -> None:
        """Release Orbax's threads."""
        self._manager.close()


def _reason(error: Exception) -> str:
    """An error's message in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]


def _fill(template: Any, stored: dict[str, np.ndarray]) -> Any:
    """Put stored arrays into the template's structure."""
    wrong, leaves = [], []
    for path, leaf in named_leaves(template).items():
        shape = jax.eval_shape(numbers, leaf)
        array = stored.get(path)
        if not np.prod(shape.shape):
            array = np.zeros(shape.shape, shape.dtype)
        if array is None:
            wrong.append(f"{path}: missing")
            continue
        if array.shape != shape.shape or array.dtype != shape.dtype:
            wrong.append(
                f"{path}: {array.dtype}{list(array.shape)} saved, "
                f"{shape.dtype}{list(shape.shape)} wanted"
            )
            continue
        leaves.append(like(jnp.array(array), leaf))
    if wrong:
        shown = "; ".join(wrong[:5]) + (" ..." if len(wrong) > 5 else "")
        raise CheckpointMismatch(f"checkpoint of another configuration: {shown}")
    return jax.tree.unflatten(jax.tree.structure(template), leaves)
