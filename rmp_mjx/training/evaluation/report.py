"""What an evaluation leaves for its reader: a table, eval.json, plots."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import polars as pl
from rich.markup import escape
from rich.table import Table

from rmp_mjx.files import write_text
from rmp_mjx.training.evaluation import figures
from rmp_mjx.training.evaluation.evaluate import Episodes, over_seeds, summarise
from rmp_mjx.training.runs import run_folder

Summary = Mapping[str, Any]
Columns = Mapping[str, Summary]
"""Summaries by engine, the run's own first."""

TERMINAL = 80
"""Columns of a terminal that the table must fit."""

MEASURES = (
    ("mean return", "return_mean", 1.0),
    ("success [%]", "success_rate", 100.0),
    ("collision [%]", "collision_rate", 100.0),
    ("joint limit [%]", "joint_limit_rate", 100.0),
    ("self-collision [%]", "self_collision_rate", 100.0),
    ("policy steps", "length_mean", 1.0),
    ("worst contact [N]", "contact_force_peak_max", 1.0),
    ("least clearance [mm]", "clearance_mean", 1e3),
    ("its worst [mm]", "clearance_min", 1e3),
    ("force at work [N]", "work_force_mean", 1.0),
    ("torque saturated [%]", "torque_saturation_mean", 100.0),
    ("set-point error [mm]", "tracking_error_mean", 1e3),
)
"""What the table shows where a task has it: label, name in a summary, factor.

Shares are of the episodes, that of saturation is of the time.
"""

FAULTS = (
    ("episodes lost to a non-finite state", "lost_episodes"),
    ("most spheres without a place in an episode", "unplaced_obstacles_max"),
    ("steps with more contacts than were read", "contact_overflow_max"),
)
"""What the table's caption mentions where it happened: label, name in a summary."""


def table(columns: Columns, title: str, own: Iterable[str] = ()) -> Table:
    """The measures that a reader wants first, with 95 % intervals.

    Args:
        columns: Summaries by engine.
        title: What was evaluated.
        own: Metrics of the task itself, shown by their means.
    """
    faults = [
        f"{label}: {summary[key]:g} ({engine})"
        for label, key in FAULTS
        for engine, summary in columns.items()
        if summary.get(key)
    ]
    shown = Table(
        title=escape(title),
        caption="\n".join(faults) or None,
        min_width=min(len(title), TERMINAL),
    )
    shown.add_column("episodes (95 %)")
    for engine in columns:
        shown.add_column(escape(engine), justify="right")
    spread = (
        f"{_number(s['return_mean'])} +- {_number(s['return_sd'])}"
        for s in columns.values()
    )
    shown.add_row("return, mean +- sd", *spread)
    own_rows = [(name.replace("_", " "), f"{name}_mean", 1.0) for name in own]
    for label, key, factor in (*MEASURES, *own_rows):
        if all(key in summary for summary in columns.values()):
            cells = (escape(_cell(s, key, factor)) for s in columns.values())
            shown.add_row(escape(label), *cells)
    return shown


def _cell(summary: Summary, key: str, factor: float) -> str:
    """A value, with its interval where it has one."""
    text, bounds = _number(factor * summary[key]), summary.get(f"{key}_ci95")
    if bounds:
        text += f" [{', '.join(_number(factor * bound) for bound in bounds)}]"
    return text


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


def save(
    results: Mapping[str, Episodes],
    reductions: Mapping[str, str],
    about: Mapping[str, Any],
    folder: Path,
    title: str,
) -> Columns:
    """Write `eval.json`, every episode's values, and the two histograms.

    Args:
        results: Values of each episode by engine. The first one's summary is the
            file's, a second one stands under `reference`.
        reductions: How the environment's metrics fold.
        about: What was evaluated, and how.
        folder: Where the files go.
        title: Heading of the plots.

    Returns:
        Summaries by engine.
    """
    folder.mkdir(parents=True, exist_ok=True)
    columns = {
        name: {**summarise(values, reductions), "engine": name}
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
        ("contact_force_peak", figures.plot_forces, run_folder.FORCES),
        ("clearance", figures.plot_clearances, run_folder.CLEARANCES),
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
