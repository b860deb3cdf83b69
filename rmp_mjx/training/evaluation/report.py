"""What an evaluation leaves for its reader: a table, eval.json, plots."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import polars as pl
from rich.markup import escape
from rich.table import Table

from rmp_mjx.files import write_text
from rmp_mjx.metric import LENGTH, RETURN, Metric, Statistic, number
from rmp_mjx.training.evaluation import plots
from rmp_mjx.training.evaluation.evaluate import Episodes, over_seeds, summarise
from rmp_mjx.training.runs import run_folder

Summary = Mapping[str, Any]
Columns = Mapping[str, Summary]
"""Summaries by engine, the run's own first."""

TERMINAL = 80
"""Columns of a terminal that the table must fit."""

LOST = "episodes lost to a non-finite state"


def table(columns: Columns, title: str, metrics: Mapping[str, Metric]) -> Table:
    """What the metrics want shown of an evaluation, with 95 % intervals.

    A row without a further word is a mean, or for `%` a share: of the episodes, or of
    the time. Below the table stands what went wrong.

    Args:
        columns: Summaries by engine.
        title: What was evaluated.
        metrics: The environment's metrics.
    """
    faults = [(LOST, "lost_episodes")]
    faults += [(m.fault, f"{m.name}_max") for m in metrics.values() if m.fault]
    caption = [
        f"{fault}: {summary[key]:g} ({engine})"
        for fault, key in faults
        for engine, summary in columns.items()
        if summary.get(key)
    ]
    shown = Table(
        title=escape(title),
        caption="\n".join(caption) or None,
        min_width=min(len(title), TERMINAL),
    )
    shown.add_column("episodes (95 %)")
    for engine in columns:
        shown.add_column(escape(engine), justify="right")
    spread = (
        f"{number(s['return_mean'])} +- {number(s['return_sd'])}"
        for s in columns.values()
    )
    shown.add_row("return, mean +- sd", *spread)
    for metric in (RETURN, LENGTH, *metrics.values()):
        for statistic in metric.table:
            cells = [_cell(s, metric, statistic) for s in columns.values()]
            if all(cells):
                shown.add_row(
                    escape(_row_label(metric, statistic)), *map(escape, cells)
                )
    return shown


def _row_label(metric: Metric, statistic: Statistic) -> str:
    """For instance `collision [%]`, `clearance [mm]`, `clearance, min [mm]`."""
    unit = "%" if statistic == "rate" else metric.shown_unit
    word = f", {statistic}" if statistic in ("min", "max") else ""
    return f"{metric.label}{word}" + (f" [{unit}]" if unit else "")


def _cell(summary: Summary, metric: Metric, statistic: Statistic) -> str:
    """A value, with its interval where it has one; empty where there is none."""
    key = f"{metric.name}_{statistic}"
    if key not in summary:
        return ""
    factor = 100.0 if statistic == "rate" else metric.factor
    text, bounds = number(factor * summary[key]), summary.get(f"{key}_ci95")
    if bounds:
        text += f" [{', '.join(number(factor * bound) for bound in bounds)}]"
    return text


def save(
    results: Mapping[str, Episodes],
    metrics: Mapping[str, Metric],
    about: Mapping[str, Any],
    folder: Path,
    title: str,
) -> Columns:
    """Write `eval.json`, every episode's values, and the two histograms.

    Args:
        results: Values of each episode by engine. The first one's summary is the
            file's, a second one stands under `reference`.
        metrics: The environment's metrics.
        about: What was evaluated, and how.
        folder: Where the files go.
        title: Heading of the plots.

    Returns:
        Summaries by engine.
    """
    folder.mkdir(parents=True, exist_ok=True)
    columns = {
        name: {**summarise(values, metrics), "engine": name}
        for name, values in results.items()
    }
    own, *others = columns.values()
    values = {**own, **about} | ({"reference": others[0]} if others else {})
    path = folder / run_folder.EVALUATION
    write_text(path, json.dumps(values, indent=2) + "\n")
    rows = [
        pl.DataFrame(dict(values)).with_columns(engine=pl.lit(name))
        for name, values in results.items()
    ]
    pl.concat(rows).write_parquet(folder / run_folder.EPISODES)
    for metric, plot, name in (
        ("contact_force_peak", plots.plot_forces, run_folder.FORCES),
        ("clearance", plots.plot_clearances, run_folder.CLEARANCES),
    ):
        found = {k: values[metric] for k, values in results.items() if metric in values}
        if found:
            plot(found, folder / name, title)
    return columns


def save_over_seeds(
    seeds: Sequence[Columns], about: Mapping[str, Any], folder: Path
) -> Columns:
    """Write the `eval.json` of several seeds, whose own stand in folders below.

    Args:
        seeds: What `save` returned for each seed.
        about: What was evaluated, and how.
        folder: Where the file goes.

    Returns:
        Statistics over the seeds by engine.
    """
    columns = {
        name: {**over_seeds([columns[name] for columns in seeds]), "engine": name}
        for name in seeds[0]
    }
    own, *_ = columns.values()
    path = folder / run_folder.EVALUATION
    write_text(path, json.dumps({**own, **about}, indent=2) + "\n")
    return columns
