"""Cells of the grid: a task, a variant of the controller, a seed."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import envs
from envs.cli import REFERENCE, make_config
from envs.options import Options
from rmp_mjx.training.config import ConfigError, TrainConfig

TASKS = {
    "trajectory": "trajectory following",
    "door": "door opening",
    "push": "block pushing",
}
"""Tasks and what to call them."""


@dataclass(frozen=True)
class Variant:
    """A controller under the policy, and how it is trained."""

    label: str
    """What figures and tables call it."""
    controller: str
    """Its name."""
    color: str
    """Its colour in figures."""
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the task in training."""


VARIANTS = {
    "vices": Variant("VICES", "vices", "#c0504d"),
    "rmp_vices": Variant("RMP-VICES", "rmp_vices", "#2a6fbb"),
    "rmp_vices_literal": Variant(
        "RMP-VICES, the paper's formulas", "rmp_vices_literal", "#d9a13b"
    ),
    "vices_penalty": Variant(
        "VICES, penalty only", "vices", "#8064a2", {"terminate_on_event": False}
    ),
    "osc": Variant("OSC, fixed impedance", "osc", "#7f7f7f"),
    "vices_cbf": Variant("VICES, CBF filter", "vices_cbf", "#3a9d5d"),
}
"""Variants by name: the paper's two, then the baselines."""

PAPER = ("vices", "rmp_vices")
"""The variants of the paper."""
BASELINES = tuple(name for name in VARIANTS if name not in PAPER)
"""The others."""


@dataclass(frozen=True, order=True)
class Cell:
    """One training run and its deployments."""

    task: str
    """Name of the task."""
    variant: str
    """Name of the variant."""
    seed: int
    """Seed of training."""

    def __str__(self) -> str:
        return f"{self.task}/{self.variant}/{self.seed}"

    @property
    def file(self) -> str:
        """Its name in file names."""
        return f"{self.task}-{self.variant}-{self.seed}"


def parse(text: str) -> Cell:
    """A cell from task/variant/seed.

    Raises:
        ConfigError: It is not one; the message lists the valid names.
    """
    parts = text.split("/")
    if len(parts) != 3 or parts[0] not in TASKS or parts[1] not in VARIANTS:
        raise ConfigError(
            f"no cell {text!r}: a cell reads TASK/VARIANT/SEED; "
            f"tasks: {', '.join(TASKS)}; variants: {', '.join(VARIANTS)}"
        )
    task, variant, seed = parts
    if not seed.isdecimal():
        raise ConfigError(f"no cell {text!r}: the seed must be a whole number")
    return Cell(task, variant, int(seed))


@dataclass(frozen=True)
class Preset:
    """How large the experiment is."""

    name: str
    """Its name."""
    seeds: int
    """Seeds of the paper's variants."""
    baseline_seeds: int
    """Seeds of the baselines."""
    training: TrainConfig[Options]
    """What all cells share."""
    episodes: int
    """Episodes of the columns of the deployment table."""
    other_episodes: int
    """Episodes of the other columns."""
    columns: tuple[str, ...]
    """Names of the columns."""
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the tasks, in training and in deployment."""

    def cells(self, baselines: bool = False) -> list[Cell]:
        """Cells in their order: one seed of every cell, then the next."""
        groups = [(PAPER, self.seeds)]
        groups += [(BASELINES, self.baseline_seeds)] if baselines else []
        return [
            Cell(task, variant, seed)
            for variants, seeds in groups
            for seed in range(seeds)
            for task in TASKS
            for variant in variants
        ]

    def config(self, cell: Cell) -> TrainConfig[Options]:
        """The training of a cell."""
        variant = VARIANTS[cell.variant]
        options = self.options | variant.options
        task = envs.make_options(cell.task, controller=variant.controller, **options)
        return self.training.replace(task=task, seed=cell.seed)


def settings(preset: Preset) -> dict[str, Any]:
    """What all trainings of a preset share, by name."""
    config = preset.training
    values = dataclasses.asdict(config.ppo)
    del values["reward_scaling"]  # of another trainer
    del values["demos"]  # there are none
    if values["final_log_std"] is None:  # nothing is annealed
        del values["final_log_std"], values["anneal_steps"]
    return values | {"num_timesteps": config.run.num_timesteps}


def definition(preset: Preset, cell: Cell) -> dict[str, Any]:
    """The values that define a training: of equal ones, one is enough.

    They are named as in the stored results, whose options are texts.
    """
    variant = VARIANTS[cell.variant]
    task = preset.config(cell).task
    return settings(preset) | {
        "env": task.env,
        "controller": task.controller,
        "physics": task.physics,
        "env_options": texts(preset.options, variant.options),
        "seed": cell.seed,
    }


def texts(*options: Mapping[str, Any]) -> list[str]:
    """Options as they stand in the stored results."""
    return [f"{name}={value}" for each in options for name, value in each.items()]


_PROTOCOL = make_config(
    num_timesteps=1_500_000, hidden_sizes=(64, 64), eval_episodes=0, video=False
)
_TINY = _PROTOCOL.replace(
    num_envs=16,
    unroll_length=8,
    num_minibatches=2,
    num_updates_per_batch=2,
    num_timesteps=1024,
    checkpoint_interval=4,
)
_COLUMNS = (
    "close",
    "far",
    "free",
    "four",
    "moving",
    "noise",
    "delay",
    "engine",
    "armature",
)

PRESETS = {
    "smoke": Preset(
        name="smoke",
        seeds=2,
        baseline_seeds=1,
        training=_TINY,
        episodes=8,
        other_episodes=4,
        columns=("close", "free"),
        options={"episode_length": 32},
    ),
    "cpu": Preset("cpu", 5, 3, _PROTOCOL, 1000, 100, _COLUMNS),
    "full": Preset("full", 10, 10, _PROTOCOL, 1000, 100, _COLUMNS),
}
"""Presets by name."""


def home(preset: Preset) -> Path:
    """Where a preset's store lies unless it is told otherwise."""
    return Path("runs/paper") / preset.name


def load(config: TrainConfig) -> envs.ArmEnv:
    """The task of a configuration."""
    return envs.make(config.task)


@dataclass(frozen=True)
class Column:
    """One world."""

    name: str
    """Its name."""
    label: str
    """What figures and tables call it."""
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the task, beside the training's."""
    physics: str | None = None
    """Physics engine; None: the training's."""


_CLOSE = {"obstacles": 2, "layout": "close"}

COLUMNS = {
    column.name: column
    for column in (
        Column("close", "2 spheres, close", _CLOSE),
        Column("far", "2 spheres, far", {"obstacles": 2, "layout": "far"}),
        Column("free", "no obstacles"),
        Column("four", "4 spheres", {"obstacles": 4, "layout": "close"}),
        Column("moving", "spheres at 0.1 m/s", _CLOSE | {"obstacle_speed": 0.1}),
        Column("noise", "1 cm noise", _CLOSE | {"obstacle_noise": 0.01}),
        Column("delay", "100 ms delay", _CLOSE | {"obstacle_delay": 0.1}),
        Column("engine", "2nd engine", _CLOSE | REFERENCE["mujoco"], "mujoco"),
        Column("armature", "robosuite armature", _CLOSE | {"armature": "robosuite"}),
    )
}
"""Columns by name; all but the first three are among two close spheres but for what
their label says."""

TABLE = ("close", "far")
"""The columns of the deployment table."""
PICTURED = "close"
"""The column whose first episodes are recorded: pictures, and what each event was."""
