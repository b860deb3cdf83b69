"""What run folders say: configurations, rows, evaluations, in groups of equal runs."""

import dataclasses
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from rmp_mjx.files import read_json
from rmp_mjx.training.config import PPOConfig, RunConfig, TrainConfig
from rmp_mjx.training.records import RecordedTask, config_of, defining, read_record
from rmp_mjx.training.runs import run_folder
from rmp_mjx.training.runs.metrics import SEED

COLORS = ("#2a6fbb", "#c0504d", "#d9a13b", "#4f9d69", "#7d5ba6", "#5b5b5b")
"""One for each group, repeated."""
COLUMNS = ("iteration", "steps", "nonfinite_envs", "time/steps_per_s")
"""Columns that the rows of every run have."""
SEEDS = ("seed", "num_seeds")
"""Options in which the runs of a group may differ."""


@dataclass(frozen=True)
class Run:
    """What a run folder says about one seed."""

    folder: Path
    """Folder of the run."""
    config: TrainConfig
    """Its configuration."""
    seed: int
    """The seed."""
    rows: pl.DataFrame
    """Its rows, with the seed as a column."""
    evaluation: dict[str, Any]
    """Its evaluation; empty if there is none."""


@dataclass(frozen=True)
class Group:
    """Runs that differ in their seed only."""

    name: str
    """Name on the page."""
    color: str
    """Color on the page."""
    runs: list[Run]
    """The runs, one for each seed."""

    @property
    def rows(self) -> pl.DataFrame:
        """The rows of all runs; the same seed twice counts as two."""
        frames = (
            run.rows.with_columns(pl.lit(k).alias(SEED))
            for k, run in enumerate(self.runs)
        )
        return pl.concat(list(frames), how="diagonal_relaxed")

    def counted(self, event: str) -> tuple[int, int]:
        """Evaluation episodes with an event, and all of them."""
        name = f"{event}_episodes"
        found = [r.evaluation for r in self.runs if name in r.evaluation]
        return sum(f[name] for f in found), sum(f["episodes"] for f in found)


def read_config(folder: Path) -> TrainConfig[RecordedTask]:
    """A run's configuration; it may be of version 0.1, which had no parts.

    Raises:
        ConfigError: The folder is no run, or its configuration cannot be read.
    """
    record = read_record(folder / run_folder.CONFIG)
    if "ppo" not in record:
        parts: dict[str, dict[str, Any]] = {"ppo": {}, "run": {}, "task": {}}
        for name, value in record.items():
            owner = "ppo" if name in _names(PPOConfig) else "task"
            parts["run" if name in _names(RunConfig) else owner][name] = value
        record = parts
    return config_of(record, RecordedTask)


def _names(kind: type[Any]) -> set[str]:
    return {field.name for field in dataclasses.fields(kind)}


def read_run(folder: Path) -> list[Run]:
    """A run's seeds.

    Raises:
        ValueError: The folder is no run, has no rows yet, or a file is damaged.
    """
    config = read_config(folder)
    path = folder / run_folder.METRICS
    if not path.exists():
        raise ValueError(f"{folder} has no rows yet: no {path.name}")
    try:
        rows = pl.read_parquet(path)
        numbers = rows.select(COLUMNS).cast(pl.Float64)
    except (pl.exceptions.PolarsError, OSError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    if numbers.is_empty():
        raise ValueError(f"{folder} has no rows yet: {path.name} is empty")
    if SEED not in rows.columns:
        rows = rows.with_columns(pl.lit(config.ppo.seed).alias(SEED))
    runs = []
    for (seed,), own in rows.group_by(SEED, maintain_order=True):
        place = run_folder.seed_folder(config, folder, seed)
        evaluation = _evaluation(place / run_folder.EVALUATION)
        runs.append(Run(folder, config, seed, own, evaluation))
    return runs


def _evaluation(path: Path) -> dict[str, Any]:
    """The numbers of an evaluation by name; empty if there is none.

    Raises:
        ValueError: The file is damaged.
    """
    found = read_json(path) if path.exists() else {}
    if not isinstance(found, dict):
        raise ValueError(f"{path} is no evaluation")
    return {name: value for name, value in found.items() if type(value) in (int, float)}


def grouped(runs: Iterable[Run]) -> list[Group]:
    """Runs by what defines them, in the order in which they are first named."""
    by_config: dict[str, list[Run]] = {}
    for run in runs:
        key = json.dumps(settings(run.config), sort_keys=True)
        by_config.setdefault(key, []).append(run)
    configs = [members[0].config for members in by_config.values()]
    varying = differences(configs)
    groups: list[Group] = []
    for k, (members, config) in enumerate(
        zip(by_config.values(), configs, strict=True)
    ):
        words = [f"{name} {text(values[k])}" for name, values in varying.items()]
        name = ", ".join(words) or config.task.title
        groups.append(Group(name, COLORS[k % len(COLORS)], members))
    return groups


def settings(config: TrainConfig) -> dict[str, Any]:
    """What defines a run except for its seeds, by name."""
    values = defining(config.record())
    return {name: value for name, value in values.items() if name not in SEEDS}


def differences(configs: Sequence[TrainConfig]) -> dict[str, list[Any]]:
    """Options that differ between configurations, and their values."""
    found = [settings(config) for config in configs]
    names = dict.fromkeys(name for each in found for name in each)
    values = {name: [each.get(name) for each in found] for name in names}
    return {n: each for n, each in values.items() if len(set(map(text, each))) > 1}


def text(value: Any) -> str:
    """An option's value in words."""
    if isinstance(value, (list, tuple)):
        return " ".join(map(str, value)) or "-"
    return str(value)
