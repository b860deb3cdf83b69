"""The pictures of a training run: the learning curve, and a page of the rest."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from rmp_mjx.metric import LENGTH, RETURN, Metric
from rmp_mjx.training.evaluation import curves, plots
from rmp_mjx.training.evaluation.curves import Stroke
from rmp_mjx.training.runs.metrics import SEED

RUN = Stroke(plots.RUN, "this run")
"""How a run's own curve is drawn."""
PANELS = 6
"""Panels of the learning curve at most."""
COLUMNS = 4
"""Panels in a row of the second page."""
LINE = 150
"""Characters of a line below the panels."""


@dataclass(frozen=True)
class Baseline:
    """Runs to compare with."""

    label: str
    """What the legend calls them."""
    rows: pl.DataFrame
    """Their rows, with the column `seed`."""


def plot_learning_curve(
    rows: pl.DataFrame,
    metrics: Mapping[str, Metric],
    picture: Path,
    title: str,
    baseline: Baseline | None = None,
) -> None:
    """Plot what a person wants to know of a training run first, on one page.

    That is the return, every metric with a headline, and the episode length. What is
    zero throughout is said in a line of text, and drawn only beside a baseline that is
    not. With several seeds the bold curve is their interquartile mean, and the band
    its 95 % bootstrap interval.

    Args:
        rows: Rows of a run.
        metrics: The environment's metrics.
        picture: PNG file to write.
        title: Heading.
        baseline: Runs to compare with, up to the run's last step.
    """
    drawn = panels(rows, metrics, baseline)
    known = _known(metrics)
    steps, last = curves.window(rows), curves.last_step(rows)
    wide = 2 if len(drawn) == 4 else min(3, len(drawn))
    high = -(-len(drawn) // wide)
    size = 10.0, 1.1 + 2.3 * high
    with plots.page(picture, high, wide, size) as (figure, axes):
        for column, axis in zip(drawn, axes, strict=False):
            scale = curves.factor(column, known)
            if baseline and column in baseline.rows.columns:
                other = baseline.rows.filter(pl.col("steps") <= last)
                stroke = Stroke(plots.OTHER, baseline.label, thin=False)
                curves.draw(axis, other, column, scale, steps, stroke)
            curves.draw(axis, rows, column, scale, steps, RUN)
            plots.finish(axis, curves.title(column, known), last)
        plots.tidy(axes, len(drawn), wide)
        plots.heading(figure, title)
        lines = _explained(rows, baseline)
        if zero := zero_throughout(rows, metrics):
            lines += textwrap.wrap(f"Zero throughout: {', '.join(zero)}.", LINE)
        plots.caption(figure, "\n".join(lines))
        if baseline:
            handles, labels = axes[0].get_legend_handles_labels()
            figure.legend(
                handles[::-1], labels[::-1], loc="outside upper right", ncols=2
            )


def plot_details(
    rows: pl.DataFrame, metrics: Mapping[str, Metric], picture: Path, title: str
) -> None:
    """Plot everything that a run recorded and the learning curve does not show.

    Args:
        rows: Rows of a run.
        metrics: The environment's metrics.
        picture: PNG file to write.
        title: Heading.
    """
    known = _known(metrics)
    shown = panels(rows, metrics)
    rest = [m.column for m in known.values() if m.column in rows.columns]
    rest += [n for n in rows.columns if n.startswith(curves.LEARNING)]
    rest = [n for n in rest if n not in shown]
    zero = [n for n in rest if curves.is_zero(rows[n])]
    drawn = [n for n in rest if n not in zero]
    steps, last = curves.window(rows), curves.last_step(rows)
    high = max(1, -(-len(drawn) // COLUMNS))
    size = 10.0, 1.2 + 1.6 * high
    with plots.page(picture, high, COLUMNS, size) as (figure, axes):
        for column, axis in zip(drawn, axes, strict=False):
            scale = curves.factor(column, known)
            curves.draw(axis, rows, column, scale, steps, RUN)
            plots.finish(axis, curves.title(column, known, short=True), last)
        plots.tidy(axes, len(drawn), COLUMNS)
        plots.heading(figure, f"{title}: details of training")
        lines = _explained(rows)
        if zero:
            names = ", ".join(curves.label(n, known) for n in zero)
            lines += textwrap.wrap(f"Zero throughout: {names}.", LINE)
        plots.caption(figure, "\n".join(lines))


def panels(
    rows: pl.DataFrame,
    metrics: Mapping[str, Metric],
    baseline: Baseline | None = None,
) -> list[str]:
    """Columns of the learning curve in their order: what is not zero throughout."""

    def moves(column: str) -> bool:
        compared = [rows, baseline.rows] if baseline else [rows]
        found = [r[column] for r in compared if column in r.columns]
        return column in rows.columns and not all(map(curves.is_zero, found))

    headlines = [m for m in metrics.values() if m.headline]
    others = [m for m in headlines if not m.event]
    events = [m for m in headlines if m.event]
    ordered = [RETURN, *others, *events, LENGTH]
    return [m.column for m in ordered if moves(m.column)][:PANELS]


def zero_throughout(rows: pl.DataFrame, metrics: Mapping[str, Metric]) -> list[str]:
    """Labels of the events, and of what has a headline, that are 0 in every row."""
    wanted = [m for m in metrics.values() if m.event or m.headline]
    found = [m for m in wanted if m.column in rows.columns]
    return [m.label for m in found if curves.is_zero(rows[m.column])]


def _explained(rows: pl.DataFrame, baseline: Baseline | None = None) -> list[str]:
    """How to read the curves."""
    window = plots.steps(curves.window(rows), digits=2)
    mean = f"running mean over {window} policy steps"
    count = rows[SEED].n_unique() if SEED in rows.columns else 1
    band = "95 % bootstrap interval"
    if count > 1:
        line = f"Thin: each seed, {mean}. Bold: interquartile mean of the {count} "
        return [f"{line}seeds, with its {band}."]
    line = f"Thin: every iteration. Bold: {mean}."
    return [f"{line} Band: {band} over the baseline's seeds." if baseline else line]


def _known(metrics: Mapping[str, Metric]) -> dict[str, Metric]:
    """The environment's metrics and those that every run has."""
    return {RETURN.name: RETURN, LENGTH.name: LENGTH, **metrics}
