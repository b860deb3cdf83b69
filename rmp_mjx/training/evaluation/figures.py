"""Plots of a run: learning curves, contact forces, clearances."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import polars as pl
from jaxtyping import Float

from rmp_mjx.training.runs.metrics import SEED

GROUPS = ("episode/", "per_1000_steps/")
HIDDEN = ("episode/finished",)
FORCES = np.geomspace(0.1, 1e4, 26)
"""Bins of the force histogram, five a decade [N]."""
COLORS = ("tab:blue", "tab:orange")
"""One for each engine."""


@contextmanager
def _figure(path: Path, lines: int, columns: int, size: tuple[float, float]):
    """Axes of a figure that is written to `path` in the end."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width, height = size
    figure = Figure(figsize=(width * columns, height * lines), layout="constrained")
    FigureCanvasAgg(figure)
    yield figure, np.atleast_1d(figure.subplots(lines, columns)).ravel()
    figure.savefig(path, dpi=120)


def curves(rows: pl.DataFrame) -> list[str]:
    """Columns of a run's metrics that are worth a curve."""
    return [n for n in rows.columns if n.startswith(GROUPS) and n not in HIDDEN]


def plot_learning_curve(
    metrics: Path, picture: Path, title: str, seeds: pl.DataFrame | None = None
) -> None:
    """Plot every per-episode mean and event rate over the policy steps.

    Args:
        metrics: Parquet file of a run.
        picture: PNG file to write.
        title: Heading.
        seeds: Curves over the seeds, where there are several (`metrics.over_seeds`):
            they stand out, with their intervals, from those of the seeds.
    """
    rows = pl.read_parquet(metrics)
    names = curves(rows)
    runs = [rows] if seeds is None else rows.partition_by(SEED)
    columns = 3
    lines = -(-len(names) // columns)
    with _figure(picture, lines, columns, (4.0, 2.4)) as (figure, axes):
        for name, axis in zip(names, axes, strict=False):
            for run in runs:
                shown = run.select("steps", name).drop_nulls()
                thin = {"lw": 1.2} if seeds is None else {"lw": 0.5, "color": "0.7"}
                axis.plot(shown["steps"], shown[name], **thin)
            if seeds is not None and name in seeds.columns:
                band = seeds.select("steps", "^" + name + "(_low|_high)?$").drop_nulls()
                steps, middle, low, high = band.get_columns()
                axis.fill_between(steps, low, high, color=COLORS[0], alpha=0.3, lw=0)
                axis.plot(steps, middle, lw=1.4, color=COLORS[0])
            axis.set_title(name.replace("_", " "), fontsize=9)
            axis.tick_params(labelsize=8)
            axis.grid(alpha=0.3)
        for axis in axes[len(names) :]:
            axis.set_axis_off()
        for axis in axes[max(0, len(names) - columns) : len(names)]:
            axis.set_xlabel("policy steps", fontsize=8)
        figure.suptitle(title, fontsize=10)


def plot_forces(
    peaks: Mapping[str, Float[np.ndarray, " n"]], picture: Path, title: str
) -> None:
    """Histogram of the greatest contact force of each episode that had a contact.

    Args:
        peaks: Greatest force of each episode by engine [N]; 0 without a contact.
        picture: PNG file to write.
        title: Heading.
    """
    touched = {name: values[values > 0.0] for name, values in peaks.items()}
    with _figure(picture, 1, 1, (5.0, 3.2)) as (_, (axis,)):
        for (name, values), color in zip(touched.items(), COLORS, strict=False):
            label = f"{name}: {len(values)} of {len(peaks[name])} episodes"
            clipped = np.clip(values, FORCES[0], FORCES[-1])
            axis.hist(clipped, FORCES, alpha=0.6, color=color, label=label)
        if not any(map(len, touched.values())):
            episodes = " + ".join(str(len(values)) for values in peaks.values())
            text = f"no contact in {episodes} episodes"
            axis.text(0.5, 0.5, text, ha="center", transform=axis.transAxes)
        axis.set_xscale("log")
        axis.set_xlim(FORCES[0], FORCES[-1])
        axis.set_xlabel("greatest contact force of an episode [N]")
        _finish(axis, title)


def plot_clearances(
    clearances: Mapping[str, Float[np.ndarray, " n"]], picture: Path, title: str
) -> None:
    """Histogram of each episode's least clearance; 0 is contact.

    Args:
        clearances: Least clearance of each episode by engine [m].
        picture: PNG file to write.
        title: Heading.
    """
    with _figure(picture, 1, 1, (5.0, 3.2)) as (_, (axis,)):
        values = [100.0 * x for x in clearances.values()]
        low, high = min(map(np.min, values)), max(map(np.max, values))
        bins = np.linspace(min(low, 0.0), max(high, 0.1), 31)
        for name, x, color in zip(clearances, values, COLORS, strict=False):
            label = f"{name}: median {np.median(x):.1f}, least {np.min(x):.1f} cm"
            axis.hist(x, bins, alpha=0.6, color=color, label=label)
        axis.axvline(0.0, color="0.2", lw=1.0)
        axis.set_xlabel("least clearance of an episode [cm]")
        _finish(axis, title)


def _finish(axis, title: str) -> None:
    axis.set_ylabel("episodes")
    axis.yaxis.get_major_locator().set_params(integer=True)
    axis.set_ylim(0.0, 1.3 * max(1.0, axis.get_ylim()[1]))  # room for the legend
    axis.set_title(title, fontsize=9)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, loc="upper left")
