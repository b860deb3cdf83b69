"""Checks of every iteration: non-finite numbers, and metrics that mean a fault."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

from rmp_mjx.metric import Metric
from rmp_mjx.training.config import TrainConfig
from rmp_mjx.training.learning import faults, seeds
from rmp_mjx.training.learning.learner import TrainState
from rmp_mjx.training.runs import run_folder
from rmp_mjx.training.runs.metrics import SEED, Row
from rmp_mjx.training.runs.saving import Commands, then

MAX_LOST_FRACTION = 0.5
"""Training stops if a larger share of an iteration's steps becomes non-finite."""
MAX_DUMPS = 5
"""Non-finite steps of a run that are written to files."""


class Watch:
    """Checks every iteration; reports and writes what it finds."""

    def __init__(
        self,
        config: TrainConfig,
        metrics: Mapping[str, Metric],
        folder: Path,
        note: Callable[[str], None],
        commands: Commands,
    ):
        """Nothing has happened yet.

        Args:
            config: Configuration.
            metrics: The environment's metrics.
            folder: Run folder.
            note: Called with one line for each kind of finding, once.
            commands: The application's commands, for messages.
        """
        self._config = config
        self._meanings = {m.column: m.fault for m in metrics.values() if m.fault}
        self._folder = folder / run_folder.NONFINITE
        self._note = note
        self._commands = commands
        self._reported: set[str] = set()

    def _once(self, kind: str, message: str) -> None:
        if kind not in self._reported:
            self._reported.add(kind)
            self._note(message)

    def abort_reason(self, rows: Sequence[Row]) -> str | None:
        """Why training must stop after an iteration; None: it can continue."""
        config = self._config.ppo
        updates = config.num_updates_per_batch * config.num_minibatches
        for row in rows:
            lost = int(row["nonfinite_envs"] or 0)
            skipped = int(row.get("learning/skipped_updates") or 0)
            if lost > MAX_LOST_FRACTION * config.steps_per_iteration:
                cause = (
                    f"{lost} of {config.steps_per_iteration} steps became non-finite"
                )
            elif skipped >= updates:
                cause = f"all {updates} updates in a row had non-finite gradients"
            else:
                continue
            seed = f", seed {row[SEED]}" if SEED in row else ""
            return f"iteration {row['iteration']}{seed}: {cause}"
        return None

    def report(self, rows: Sequence[Row], fault: faults.Fault | None) -> None:
        """Report an iteration's findings.

        Args:
            rows: Its rows, one for each seed.
            fault: Its faults, fetched only if the rows count any.
        """
        for column, meaning in self._meanings.items():
            if any(row.get(column) for row in rows):
                self._once(column, f"warning: {meaning} (column {column})")
        for k, row in enumerate(rows if fault else ()):
            if row["nonfinite_envs"]:
                self._dump(row, k, seeds.of_seed(fault, k, self._config.ppo))

    def _dump(self, row: Row, index: int, fault: faults.Fault) -> None:
        """Write the first few faults for a replay."""
        config = self._config
        room = MAX_DUMPS - len(list(self._folder.glob("*.npz")))
        seed = config.ppo.seed + index
        about = {
            "config": config.record(),
            "iteration": row["iteration"],
            "seed": seed,
        }
        name = f"iteration{row['iteration']}-seed{seed}"
        try:
            files = faults.dump(fault, self._folder, name, about, max(room, 0))
        except OSError as error:
            self._once("dump", f"warning: {self._folder} cannot be written: {error}")
            return
        if files:
            self._once(
                "nonfinite",
                f"warning: iteration {row['iteration']}: {row['nonfinite_envs']} "
                "environments became non-finite and were reset, their steps left out, "
                f"the first ones written to {self._folder}"
                + then("inspect one with", self._commands.replay, files[0]),
            )


def is_finite(state: TrainState) -> bool:
    """Whether everything that has been learned is finite."""
    learned = state.learner, state.normalizer, state.scale
    leaves = jax.device_get(jax.tree.leaves(learned))
    return all(np.isfinite(leaf).all() for leaf in leaves)
