"""Where training reports: terminal, parquet file, trackers."""

import time
from collections.abc import Iterable, Mapping
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

from rmp_mjx.files import replacing
from rmp_mjx.metric import RETURN, Metric, number
from rmp_mjx.training.runs.metrics import Row, of_all_seeds
from rmp_mjx.training.runs.trackers import Tracker

PLAIN_INTERVAL = 10.0
"""Seconds between lines where the output is not a terminal."""
WRITE_INTERVAL = 5.0
"""Seconds between rewrites of the parquet file."""


class RunLogger:
    """Reports rows; a context manager.

    Reports never stop training: where the disk is full or a tracker fails, that is said
    once. The rows stay in memory, and the next write that succeeds has them all.
    """

    def __init__(
        self,
        metrics_path: Path,
        metrics: Mapping[str, Metric],
        num_iterations: int,
        first_iteration: int = 0,
        console: Console | None = None,
        trackers: Iterable[Tracker] = (),
    ):
        """Open the logs.

        Args:
            metrics_path: Parquet file, rewritten atomically as rows arrive.
            metrics: The environment's metrics: those with a headline are on the
                terminal's line.
            num_iterations: Iterations of the whole run.
            first_iteration: Iterations that are done already (a resumed run): the
                rows up to there are kept, later ones dropped.
            console: Terminal.
            trackers: Where the rows go besides.
        """
        self._path = metrics_path
        self._headlines = [m for m in (RETURN, *metrics.values()) if m.headline]
        self._console = console or Console()
        self._warned: set[str] = set()
        self._rows = self._read(first_iteration) if first_iteration else []
        self._last: Row = {}
        if self._rows:
            newest = self._rows[-1]["iteration"]
            self._last |= _combined([r for r in self._rows if r["iteration"] == newest])
        self._trackers = list(trackers)
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

    def _read(self, up_to: int) -> list[Row]:
        """Rows that an earlier process wrote."""
        if not self._path.exists():
            return []
        try:
            rows = pl.read_parquet(self._path)
        except (pl.exceptions.PolarsError, OSError) as error:
            self._warn(f"{self._path} cannot be read and is begun anew", error)
            return []
        return rows.filter(pl.col("iteration") <= up_to).to_dicts()

    def __enter__(self) -> "RunLogger":
        self._progress.start()
        if not self._console.is_terminal:
            self.note("compiling")
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self._progress.stop()
        self.flush()
        newest = int(self._last.get("iteration") or 0)
        stopped = 0 if newest >= self._total else 130
        exit_code = stopped if kind is None else 1
        for tracker in self._trackers:
            try:
                tracker.close(exit_code)
            except Exception as error:  # whatever a tracker raises
                self._warn(f"{type(tracker).__name__} failed", error)

    def note(self, message: str) -> None:
        """Print one line, above the progress bar if there is one."""
        self._console.print(message, markup=False, highlight=False, soft_wrap=True)

    def _warn(self, message: str, error: Exception) -> None:
        """Say something once."""
        if message not in self._warned:
            self._warned.add(message)
            self.note(f"warning: {message}; training goes on: {error}")

    def add(self, *rows: Row) -> None:
        """Report an iteration's rows, one for each seed."""
        self._rows += rows
        row = _combined(rows)
        self._last |= {name: value for name, value in row.items() if value is not None}
        iteration, steps = int(row["iteration"] or 0), int(row["steps"] or 0)
        values = {
            name: float(value)
            for name, value in row.items()
            if value is not None and name not in ("iteration", "steps")
        }
        for tracker in list(self._trackers):
            try:
                tracker.add(steps, values)
            except Exception as error:  # whatever a tracker raises
                self._trackers.remove(tracker)
                self._warn(f"{type(tracker).__name__} failed", error)
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
                f"{iteration}/{self._total} steps {steps:,}"
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
        """The newest values of what has a headline, after the speed."""
        found = [(m, self._last.get(m.column)) for m in self._headlines]
        shown = [headline(m, float(value)) for m, value in found if value is not None]
        speed = self._last.get("time/steps_per_s")
        pace = [] if speed is None else [f"steps/s {speed:.0f}"]
        return " ".join([*pace, *shown])

    def flush(self) -> None:
        """Write all rows to the parquet file, replacing it in one move.

        Called before a checkpoint too, so that no row of what it contains is missing.
        """
        self._written = time.monotonic()
        if not self._rows:
            return
        try:
            with replacing(self._path) as temporary:
                rows = pl.DataFrame(self._rows, infer_schema_length=None)
                rows.write_parquet(temporary)
        except (OSError, pl.exceptions.PolarsError) as error:
            self._warn(f"{self._path} cannot be written for now", error)


def headline(metric: Metric, value: float) -> str:
    """A metric on the terminal's line, for instance `success 97%` or `coll/1k 0.50`."""
    if metric.event:
        return f"{metric.headline}/1k {value:.2f}"
    unit = metric.shown_unit
    unit = unit if unit in ("", "%") else f" {unit}"
    return f"{metric.headline} {number(metric.factor * value)}{unit}"


def _combined(rows: Iterable[Row]) -> Row:
    """The rows of one iteration as one."""
    first, *others = rows
    return of_all_seeds([first, *others]) if others else first
