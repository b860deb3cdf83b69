"""One curve over training: its running mean, and its band over the seeds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import polars as pl

from rmp_mjx.metric import Metric
from rmp_mjx.training.runs.metrics import SEED, over_seeds

if TYPE_CHECKING:
    from matplotlib.axes import Axes

EPISODE, RATE, LEARNING = "episode/", "per_1000_steps/", "learning/"
"""Groups of a run's columns that are curves: means over the episodes that finished in
an iteration, sums per thousand policy steps, and what the learner reports."""
FINISHED = "episode/finished"
"""Column that counts the episodes behind the means."""
WINDOW = 0.05
"""Width of the running mean, as a share of the run."""


class Stroke(NamedTuple):
    """How a curve is drawn."""

    color: str
    """Its colour."""
    name: str
    """Its name in a legend."""
    thin: bool = True
    """Whether each iteration's value is drawn too; with several seeds, each seed's
    running mean."""


def columns(rows: pl.DataFrame) -> list[str]:
    """Columns of a run's metrics about its episodes and events."""
    return [n for n in rows.columns if n.startswith((EPISODE, RATE)) and n != FINISHED]


def label(column: str, metrics: Mapping[str, Metric]) -> str:
    """What a column is, in words: `contact force`, `learner: entropy`."""
    group, _, name = column.partition("/")
    words = metrics[name].label if name in metrics else name.replace("_", " ")
    return f"learner: {words}" if f"{group}/" == LEARNING else words


def title(column: str, metrics: Mapping[str, Metric], short: bool = False) -> str:
    """A column's label with its unit: `Contact force [N]`.

    Args:
        column: Name of the column.
        metrics: What is known of its metric, by name.
        short: Whether there is little room.
    """
    group, _, name = column.partition("/")
    words = label(column, metrics)
    words = words[:1].upper() + words[1:]
    if f"{group}/" == RATE:
        return f"{words} / 1k steps" if short else f"{words} events per 1,000 steps"
    metric = metrics.get(name) if f"{group}/" == EPISODE else None
    return f"{words} [{metric.shown_unit}]" if metric and metric.unit else words


def factor(column: str, metrics: Mapping[str, Metric]) -> float:
    """From a column's values to what its title says."""
    group, _, name = column.partition("/")
    known = f"{group}/" == EPISODE and name in metrics
    return metrics[name].factor if known else 1.0


def is_zero(values: pl.Series) -> bool:
    """Whether there are values, and all of them are 0."""
    found = values.drop_nulls()
    return len(found) > 0 and bool((found == 0).all())


def window(rows: pl.DataFrame) -> int:
    """Policy steps that the running mean of a run covers: three rows at least."""
    iteration = steps_per_row(rows)
    return iteration * max(3, round(WINDOW * last_step(rows) / iteration))


def last_step(rows: pl.DataFrame) -> int:
    """Policy steps of a run (of each of its seeds)."""
    return int(rows["steps"].to_numpy().max())


def steps_per_row(rows: pl.DataFrame) -> int:
    """Policy steps from one row to the next."""
    steps = np.unique(rows["steps"].to_numpy())
    return int(np.median(np.diff(steps, prepend=0)))


def running_mean(rows: pl.DataFrame, column: str, steps: int) -> pl.DataFrame:
    """A column's mean in a window about each row, for each seed alone.

    Means over episodes are weighted by the number of episodes: the result is the mean
    over all episodes that finished in the window.

    Args:
        rows: Rows of a run.
        column: The column.
        steps: Width of the window in policy steps.

    Returns:
        The rows with that column replaced.
    """
    width = max(1, round(steps / steps_per_row(rows)))
    by_episodes = column.startswith(EPISODE) and FINISHED in rows.columns
    weight = pl.col(FINISHED) if by_episodes else pl.lit(1.0)
    weight = pl.when(pl.col(column).is_not_null()).then(weight).otherwise(0.0)

    def total(value: pl.Expr) -> pl.Expr:
        return value.rolling_sum(width, center=True, min_samples=1)

    mean = total(pl.col(column).fill_null(0.0) * weight) / total(weight)
    mean = pl.when(total(weight) > 0).then(mean).alias(column)
    each = rows.partition_by(SEED) if SEED in rows.columns else [rows]
    return pl.concat([run.sort("steps").with_columns(mean) for run in each])


def draw(
    axis: Axes,
    rows: pl.DataFrame,
    column: str,
    scale: float,
    steps: int,
    stroke: Stroke,
) -> None:
    """Draw a column: bold its running mean, with several seeds that of all and a band.

    Args:
        axis: Where to draw.
        rows: Rows of one or more seeds.
        column: The column.
        scale: Factor to what the axis shows.
        steps: Width of the running mean in policy steps.
        stroke: Colour, name, and whether there are thin lines.
    """
    smooth = running_mean(rows, column, steps)
    several = SEED in rows.columns and rows[SEED].n_unique() > 1
    color = stroke.color
    if stroke.thin:
        for run in smooth.partition_by(SEED) if several else [rows]:
            shown = run.select("steps", column).drop_nulls()
            y = scale * shown[column]
            axis.plot(shown["steps"], y, lw=0.7, color=color, alpha=0.4)
    if several:
        band = over_seeds(smooth, [column])
        if column not in band.columns:
            return
        band = band.drop_nulls()
        middle, low, high = (
            scale * band[f"{column}{end}"].to_numpy() for end in ("", "_low", "_high")
        )
        if (middle >= 0.0).all():
            low = np.maximum(low, 0.0)
        axis.fill_between(band["steps"], low, high, color=color, alpha=0.18, lw=0)
        bold = band["steps"], middle
    else:
        shown = smooth.select("steps", column).drop_nulls()
        bold = shown["steps"], scale * shown[column]
    # Not clipped, so that a curve at 0 is not half hidden by the axis.
    axis.plot(*bold, lw=1.8, color=color, label=stroke.name, clip_on=False, zorder=3)
