"""Checkpoints: atomic, verified, complete.

A checkpoint is a flat set of arrays written by Orbax (temporary folder, then a
rename), beside a manifest with every array's path, shape, dtype and SHA-256, the name
of the run and the number of the step: Orbax itself neither detects a flipped bit nor
refuses another dtype. The sums of all files are added last and compared before Orbax
opens them, because it reports damage with one traceback for each array. Zero-size
arrays, which Orbax cannot store, come from the template; PRNG keys are stored as their
data.
"""

import contextlib
import gc
import hashlib
import json
import logging
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers as retention

from rmp_mjx.files import read_json, write_text
from rmp_mjx.trees import like, named_leaves, numbers

NEWEST, BEST = "newest", "best"
"""Checkpoints that have a name besides their number."""
SUMS = "sums.json"
"""File of a checkpoint with the SHA-256 of all others."""
METRICS = "metrics/metrics"
"""File of a checkpoint that Orbax keeps its rank in."""
MERITS = ("success", "return")
"""Means over recent episodes that rank checkpoints; the first counts most."""


class CheckpointError(RuntimeError):
    """No usable checkpoint; the message says why."""


class CheckpointMismatch(CheckpointError):
    """The checkpoint belongs to another configuration, task or run."""


class SaveError(CheckpointError):
    """A checkpoint could not be written; those before it are untouched."""


def _describe(path: str, array: np.ndarray) -> dict[str, Any]:
    return {
        "path": path,
        "shape": list(array.shape),
        "dtype": str(array.dtype),
        "sha256": hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest(),
    }


def _digest(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _sums(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a checkpoint, by its path in there."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != SUMS)
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(
            path.read_bytes()
        ).hexdigest()
        for path in sorted(files)
    }


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep the errors of Orbax's own tasks, which it also raises, off the terminal."""
    logger, hook = logging.getLogger("asyncio"), sys.unraisablehook
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    sys.unraisablehook = lambda _: None  # of reads that end after their event loop
    try:
        yield
    except Exception:
        gc.collect()  # a task speaks when it is collected
        raise
    finally:
        logger.setLevel(level)
        sys.unraisablehook = hook


def _merit(path: Path) -> dict[str, float] | None:
    """What ranks a checkpoint, from Orbax's file; None if it was not known.

    Raises:
        CheckpointError: The file is damaged.
    """
    try:
        found = read_json(path)
        return {name: float(found[name]) for name in MERITS}
    except FileNotFoundError:
        return None
    except (ValueError, TypeError, KeyError) as error:
        raise CheckpointError(f"{path} is damaged") from error


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
        run_id: str | None = None,
    ):
        """Open a folder of checkpoints.

        Args:
            folder: The folder; created unless `read_only`.
            keep: Newest checkpoints that are kept; so is the best one.
            keep_every: Checkpoints at multiples of this are kept too; 0: none.
            read_only: Do not create or clean up anything.
            run_id: Name of the run; None: it has none.

        Raises:
            CheckpointError: There is no such folder.
        """
        for name in ("absl", "orbax"):  # they narrate every save at INFO and WARNING
            logging.getLogger(name).setLevel(logging.ERROR)
        self._folder = folder.absolute()
        self._read_only = read_only
        self._run_id = run_id
        if not read_only and not self._folder.exists():
            self._folder.mkdir(parents=True)
        if not self._folder.is_dir():
            raise CheckpointError(f"no checkpoints in {folder}")
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
            lightweight_initialize=read_only,  # `_choose` alone needs the ranks
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
            for path in self._folder.glob(f"*/{METRICS}"):
                try:
                    _merit(path)
                except CheckpointError:  # Orbax would not open any of the checkpoints
                    path.unlink()
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
        content = {"arrays": manifest, "run": self._run_id, "step": step}
        try:
            parts = ocp.args.Composite(
                state=ocp.args.StandardSave(arrays),
                manifest=ocp.args.JsonSave(content | {"sha256": _digest(content)}),
            )
            with _quiet():
                self._manager.save(
                    step, args=parts, metrics=dict(merit) if merit else None
                )
                self._manager.wait_until_finished()
            own = self._folder / str(step)
            write_text(own / SUMS, json.dumps(_sums(own)))
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
            CheckpointMismatch: It is a checkpoint of another run, or has another number
                than it was saved with; or arrays are missing or have other shapes or
                dtypes.
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
            except CheckpointMismatch:
                raise
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
        afresh = not self._read_only
        return sorted(self._manager.all_steps(read=afresh), reverse=True)

    def _choose(self, which: str, steps: list[int]) -> int:
        """The step of the best checkpoint, or of the one with this number."""
        if which == BEST:
            merits = (
                (_merit(self._folder / str(step) / METRICS), step) for step in steps
            )
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
        self._check_files(step)
        manifest = self._manifest(step)["arrays"]
        shapes = {
            name: np.zeros(entry["shape"], entry["dtype"])
            for name, entry in manifest.items()
        }
        with _quiet():
            arrays = self._manager.restore(
                step,
                args=ocp.args.Composite(state=ocp.args.StandardRestore(shapes)),
            )["state"]
        stored = {}
        for name, entry in manifest.items():
            array = np.asarray(arrays[name])
            if _describe(entry["path"], array) != entry:
                raise CheckpointError(f"{entry['path']} fails its checksum")
            stored[entry["path"]] = array
        return stored

    def _check_files(self, step: int) -> None:
        """Compare the files with their sums.

        A process that was killed just before it wrote the sums leaves none, and neither
        did version 0.2: the arrays have sums of their own.
        """
        own = self._folder / str(step)
        if not (own / SUMS).exists():
            return
        wanted, found = read_json(own / SUMS), _sums(own)
        wrong = [name for name in wanted if wanted[name] != found.get(name)]
        if wrong:
            raise CheckpointError(f"{wrong[0]} fails its checksum")

    def _manifest(self, step: int) -> dict[str, Any]:
        """The manifest of a checkpoint of this run with this number."""
        with _quiet():
            manifest = self._manager.restore(
                step,
                args=ocp.args.Composite(manifest=ocp.args.JsonRestore()),
            )["manifest"]
        content = {name: manifest[name] for name in manifest if name != "sha256"}
        # Version 0.2 knew neither run nor step, and summed the arrays alone.
        summed = content if "step" in content else content["arrays"]
        if _digest(summed) != manifest["sha256"]:
            raise CheckpointError("the manifest fails its checksum")
        if content.get("run") != self._run_id:
            raise CheckpointMismatch(
                f"checkpoint {step} in {self._folder} is of another run: move it away"
            )
        if content.get("step", step) != step:
            raise CheckpointMismatch(
                f"checkpoint {step} in {self._folder} is a copy of checkpoint "
                f"{content['step']}: move it away"
            )
        return manifest

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
