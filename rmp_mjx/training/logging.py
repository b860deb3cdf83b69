"""Where training reports: terminal, TensorBoard, parquet."""

import os
import time
from pathlib import Path

import polars as pl
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from tensorboardX import SummaryWriter

from rmp_mjx.training.metrics import Row

SHOWN = (
    ("time/steps_per_s", "steps/s", ".0f"),
    ("episode/return", "return", ".1f"),
    ("episode/via_points", "via", ".2f"),
    ("per_1000_steps/via_points", "via/1k", ".1f"),
    ("episode/success", "success", ".0%"),
    ("per_1000_steps/collision", "coll/1k", ".2f"),
    ("per_1000_steps/joint_limit", "limit/1k", ".2f"),
)
"""Column, label and format of what the terminal shows, where a task has it."""
PLAIN_INTERVAL = 10.0
"""Seconds between lines where the output is not a terminal."""
WRITE_INTERVAL = 5.0
"""Seconds between rewrites of the parquet file."""


class RunLogger:
    """Reports rows; a context manager."""

    def __init__(
        self,
        metrics_path: Path,
        tensorboard_dir: Path,
        num_iterations: int,
        first_iteration: int = 0,
        console: Console | None = None,
    ):
        """Open the logs.

        Args:
            metrics_path: Parquet file, rewritten atomically as rows arrive.
            tensorboard_dir: Folder of TensorBoard's event files.
            num_iterations: Iterations of the whole run.
            first_iteration: Iterations that are done already (a resumed run): the
                rows up to there are kept, later ones dropped.
            console: Terminal.
        """
        self._path = metrics_path
        self._rows: list[Row] = []
        if first_iteration and metrics_path.exists():
            kept = pl.col("iteration") <= first_iteration
            self._rows = pl.read_parquet(metrics_path).filter(kept).to_dicts()
        self._last = dict(self._rows[-1]) if self._rows else {}
        self._tensorboard = SummaryWriter(
            str(tensorboard_dir), purge_step=first_iteration or None
        )
        self._console = console or Console()
        self._total = num_iterations
        self._progress = Progress(
            TextColumn("[bold]training"),
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("eta"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[shown]}"),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._progress.add_task(
            "", total=num_iterations, completed=first_iteration, shown="compiling"
        )
        self._first: tuple[int, float] | None = None
        self._printed = self._written = -float("inf")

    def __enter__(self) -> "RunLogger":
        self._progress.start()
        if not self._console.is_terminal:
            self.note("compiling")
        return self

    def __exit__(self, *exc: object) -> None:
        self._progress.stop()
        self.flush()
        self._tensorboard.close()

    def note(self, message: str) -> None:
        """Print one line, above the progress bar if there is one."""
        self._console.print(message, markup=False, highlight=False, soft_wrap=True)

    def add(self, row: Row) -> None:
        """Report one row."""
        self._rows.append(row)
        self._last |= {name: value for name, value in row.items() if value is not None}
        iteration = int(row["iteration"] or 0)
        for name, value in row.items():
            if value is not None and name != "iteration":
                self._tensorboard.add_scalar(name, value, int(row["steps"] or 0))
        self._progress.update(self._task, completed=iteration, shown=self._shown())
        now = time.monotonic()
        self._first = self._first or (iteration, now)
        last = iteration >= self._total
        if now - self._written > WRITE_INTERVAL:
            self.flush()
        plain = not self._console.is_terminal
        if plain and (last or now - self._printed > PLAIN_INTERVAL):
            self._printed = now
            self.note(
                f"{iteration}/{self._total} steps {row['steps']:,}"
                f"{self._eta(iteration, now)} {self._shown()}"
            )

    def _eta(self, iteration: int, now: float) -> str:
        """Time left at the pace since the first row, which contains the compiling."""
        first, began = self._first or (iteration, now)
        if iteration == first:
            return ""
        left = (now - began) / (iteration - first) * (self._total - iteration)
        return f" eta {left:.0f} s"

    def _shown(self) -> str:
        return " ".join(
            f"{label} {self._last[name]:{form}}"
            for name, label, form in SHOWN
            if self._last.get(name) is not None
        )

    def flush(self) -> None:
        """Write all rows to the parquet file, replacing it in one move."""
        self._written = time.monotonic()
        if not self._rows:
            return
        temporary = self._path.with_suffix(".tmp")
        pl.DataFrame(self._rows, infer_schema_length=None).write_parquet(temporary)
        os.replace(temporary, self._path)
