"""Train a cell: from nothing, from where it was stopped, or not at all."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl
from rich.console import Console

from benchmarks.paper import cells, store
from benchmarks.paper.cells import Cell, Preset
from benchmarks.paper.store import Store
from rmp_mjx.training.config import (
    ConfigError,
    TrainConfig,
    differing_fields,
    read_record,
)
from rmp_mjx.training.policy import PolicyError, load_policy
from rmp_mjx.training.runs import policies, run_folder
from rmp_mjx.training.runs.checkpoint import CheckpointError
from rmp_mjx.training.runs.loop import TrainResult, train


def run_of(place: Store, cell: Cell) -> Path:
    """Run folder of a cell."""
    return place.folder / "runs" / cell.file


def is_trained(place: Store, preset: Preset, cell: Cell) -> bool:
    """Whether a cell's training is in the store, and its policy with it."""
    if not place.holds(cells.definition(preset, cell), store.TRAINING, cell):
        return False
    try:
        load_policy(place.policy(cell))
    except PolicyError:
        return False
    return True


def check(place: Store, preset: Preset, cell: Cell) -> None:
    """Refuse a store of other settings before anything long starts.

    Raises:
        ConfigError: It holds another run of the cell.
    """
    saved = _saved(run_of(place, cell))
    different = differing_fields(saved, preset.config(cell)) if saved else {}
    if about := place.about(store.TRAINING, cell):
        old = about["definition"]
        new = json.loads(json.dumps(cells.definition(preset, cell)))
        names = [k for k in new if k != "num_timesteps" and new[k] != old.get(k)]
        different |= {name: (old.get(name), new[name]) for name in names}
    if different:
        changes = ", ".join(f"{k}: {a} -> {b}" for k, (a, b) in different.items())
        raise ConfigError(
            f"{place.folder} holds {cell} with other settings ({changes}): delete it, "
            "or name another folder with --folder"
        )


def train_cell(
    place: Store, preset: Preset, cell: Cell, console: Console, allow_changes: bool
) -> int:
    """Train a cell to its end and put its policy and its curves into the store.

    A run that was stopped goes on from its last checkpoint; one without any sound
    checkpoint begins anew.

    Returns:
        0, or 128 plus the signal that stopped training.

    Raises:
        ConfigError: The run cannot be continued with this code.
        TrainingFailure: The run broke down.
    """
    folder = run_of(place, cell)
    wanted = preset.config(cell)
    begin = partial(_run, wanted, folder, console, allow_changes)
    try:
        result = begin(_saved(folder) is not None)
    except CheckpointError as error:
        console.print(f"{cell} begins anew: {error}", markup=False, highlight=False)
        result = begin(False)
    if result.exit_code:
        return result.exit_code
    (written,) = policies.save(result.agent, wanted, folder, result.iterations, False)
    place.policy(cell).parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(written, place.policy(cell))
    rows = pl.read_parquet(folder / run_folder.METRICS)
    about = {
        "definition": cells.definition(preset, cell),
        "seconds": float(rows["time/iteration_s"].sum()),
        "history": json.loads((folder / run_folder.VERSIONS).read_text()),
    }
    place.write(rows, about, store.TRAINING, cell)
    return 0


def _saved(folder: Path) -> dict[str, Any] | None:
    """Record of the run in a folder; None: there is none that can be read."""
    try:
        return read_record(folder / run_folder.CONFIG)
    except ConfigError:
        return None


def _run(
    config: TrainConfig,
    folder: Path,
    console: Console,
    allow_changes: bool,
    go_on: bool,
) -> TrainResult:
    """Continue the run in a folder, or begin one there."""
    config = config.replace(
        allow_changes=allow_changes,
        resume=str(folder) if go_on else None,
        run_dir=None if go_on else str(folder),
        overwrite=not go_on,
    )
    folder, lock = run_folder.open_run(config)
    with lock:
        return train(cells.load(config), config, folder, console)
