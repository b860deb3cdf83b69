"""Train a cell: from nothing, from where it was stopped, or not at all."""

from __future__ import annotations

import json
import os
import shutil
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from rich.console import Console

from benchmarks.paper import cells, store
from benchmarks.paper.cells import Cell, Preset
from benchmarks.paper.deployment import deploy, is_deployed
from benchmarks.paper.store import Store
from rmp_mjx.training.config import ConfigError, TrainConfig
from rmp_mjx.training.policy import PolicyError, load_policy
from rmp_mjx.training.records import differing_fields, read_record
from rmp_mjx.training.runs import policies, run_folder
from rmp_mjx.training.runs.checkpoint import CheckpointError
from rmp_mjx.training.runs.loop import TrainResult, train
from rmp_mjx.training.runs.saving import StopRequest, TrainingFailure


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


@dataclass(frozen=True)
class Step:
    """One piece of work; what it leaves behind shows that it is done."""

    cell: Cell
    """Its cell."""
    column: str | None = None
    """Deployment in this column; None: training."""

    def __str__(self) -> str:
        return (
            f"deploy {self.cell}: {self.column}"
            if self.column
            else f"train {self.cell}"
        )

    @property
    def kind(self) -> str:
        """What its duration goes by."""
        return self.column or store.TRAINING


def steps(preset: Preset, wanted: Sequence[Cell]) -> list[Step]:
    """All steps in order: a round of cells is trained, then deployed, then the next.

    A round is one seed of all its cells.
    """
    ordered: list[Step] = []
    rounds: list[list[Cell]] = []
    for cell in wanted:
        if not rounds or cell.seed != rounds[-1][0].seed:
            rounds.append([])
        rounds[-1].append(cell)
    for each in rounds:
        ordered += [Step(cell) for cell in each]
        ordered += [Step(cell, name) for cell in each for name in preset.columns]
    return ordered


def is_done(place: Store, preset: Preset, step: Step) -> bool:
    """Whether a step's results are there."""
    if step.column:
        return is_deployed(place, preset, step.cell, step.column)
    return is_trained(place, preset, step.cell)


def run(
    place: Store,
    preset: Preset,
    wanted: Sequence[Cell],
    console: Console,
    seconds: float | None = None,
    allow_changes: bool = False,
) -> int:
    """Do what is missing.

    Args:
        place: The store.
        preset: The experiment.
        wanted: Cells, in order.
        console: Terminal.
        seconds: Stop at the next safe point after this long [s].
        allow_changes: Continue runs although the code has changed.

    Returns:
        0; 1 where a training failed (the others are done all the same); or 128 plus the
        signal that stopped it, which the end of `seconds` counts as.

    Raises:
        ConfigError: A run folder holds another run, or one that this code may not
            continue.
    """
    for cell in wanted:
        check(place, preset, cell)
    everything = steps(preset, wanted)
    left = [step for step in everything if not is_done(place, preset, step)]
    console.print(f"{len(everything) - len(left)} of {len(everything)} steps are done")
    spent = _spent(place)
    failed: set[Cell] = set()
    with StopRequest() as stop, _alarm(seconds):
        for number, step in enumerate(left):
            if stop.signal:
                break
            if step.cell in failed:
                continue
            done = len(everything) - len(left) + number
            eta = _eta(left[number:], spent)
            console.print(f"{done + 1}/{len(everything)} {step}{eta}", highlight=False)
            began = time.monotonic()
            try:
                code = _do(place, preset, step, console, allow_changes)
            except (TrainingFailure, CheckpointError) as error:
                console.print(f"failed: {error}", markup=False, highlight=False)
                failed.add(step.cell)
                continue
            if code:
                return code
            spent.setdefault(step.kind, []).append(time.monotonic() - began)
    if failed:
        console.print(f"failed: {', '.join(map(str, sorted(failed)))}")
    return stop.exit_code or int(bool(failed))


def _do(
    place: Store, preset: Preset, step: Step, console: Console, allow_changes: bool
) -> int:
    """Do one step; its exit code."""
    if step.column is None:
        return train_cell(place, preset, step.cell, console, allow_changes)
    deploy(place, preset, step.cell, step.column, console)
    return 0


@contextmanager
def _alarm(seconds: float | None) -> Iterator[None]:
    """Ask this process to stop after a while, as a user would."""
    if seconds is None:
        yield
        return
    timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGTERM))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _spent(place: Store) -> dict[str, list[float]]:
    """Durations of the steps that are in the store, by kind [s]."""
    spent: dict[str, list[float]] = {}
    for about in place.provenance:
        if about["kind"] != store.EVENTS:
            kind = about.get("column", store.TRAINING)
            spent.setdefault(kind, []).append(about["seconds"])
    return spent


def _eta(left: Sequence[Step], spent: dict[str, list[float]]) -> str:
    """The time that the steps will take, where all their kinds have been seen."""
    kinds: dict[str, Any] = {kind: np.mean(times) for kind, times in spent.items()}
    if any(step.kind not in kinds for step in left):
        return ""
    minutes = round(sum(kinds[step.kind] for step in left) / 60.0)
    return f", eta {minutes // 60} h {minutes % 60:02d} min"
