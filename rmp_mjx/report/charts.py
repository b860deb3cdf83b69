"""The figures of the page: learning curves, and safety in the evaluation."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rmp_mjx.report.runs import Group
from rmp_mjx.training.evaluation import curves
from rmp_mjx.training.runs.metrics import over_seeds
from rmp_mjx.training.stats import clopper_pearson

FIRST = ("episode/return", "episode/success")
"""Curves that come first."""
EVENTS = ("collision", "self_collision", "joint_limit")
"""Safety events that are counted if the tasks have them."""
PANELS = 3
"""Panels of a figure side by side."""


def split_curves(groups: Sequence[Group]) -> tuple[list[str], list[str]]:
    """Columns to draw, `FIRST` first, and those that have the same value throughout."""
    rows = [group.rows for group in groups]
    names = dict.fromkeys(
        name for each in rows for name in (*FIRST, *curves.columns(each))
    )
    moving, flat = [], []
    for name in names:
        found = [each[name].drop_nulls() for each in rows if name in each.columns]
        values = {value for column in found for value in column.unique()}
        (moving if len(values) > 1 else flat).append(name)
    return moving, flat


def learning_curves(groups: Sequence[Group], names: Sequence[str]) -> Figure:
    """Interquartile means over the seeds with their intervals, a panel each."""
    bands = []
    for group in groups:
        rows = group.rows
        present = [name for name in names if name in rows.columns]
        bands.append((group, over_seeds(rows, present)))

    def draw(axis: Any, name: str) -> None:
        for group, band in bands:
            if name not in band.columns:
                continue
            shown = band.select("steps", f"^{name}(_low|_high)?$").drop_nulls()
            steps, middle, low, high = (column / 1 for column in shown.get_columns())
            axis.fill_between(
                steps / 1e3, low, high, color=group.color, alpha=0.2, lw=0
            )
            axis.plot(
                steps / 1e3, middle, color=group.color, lw=1.4, label=_plain(group.name)
            )
        axis.set_xlabel("policy steps [thousands]", fontsize=8)

    return _panels(names, draw)


def safety(groups: Sequence[Group]) -> Figure:
    """Share of the evaluation's episodes with an event, with exact 95 % intervals."""

    def draw(axis: Any, event: str) -> None:
        for k, group in enumerate(groups):
            hits, episodes = group.counted(event)
            if not episodes:
                continue
            low, high = clopper_pearson(hits, episodes)
            share = hits / episodes
            axis.errorbar(
                k,
                100 * share,
                [[100 * (share - low)], [100 * (high - share)]],
                fmt="o",
                color=group.color,
                capsize=4,
                label=_plain(f"{group.name}: {hits} of {episodes}"),
            )
        axis.set_xticks([])
        axis.set_xlim(-0.5, len(groups) - 0.5)
        axis.set_ylabel("episodes [%]", fontsize=8)
        axis.set_ylim(bottom=0.0)

    return _panels(EVENTS, draw, every_legend=True)


def _panels(
    names: Sequence[str], draw: Callable[[Any, str], None], every_legend: bool = False
) -> Figure:
    """A figure with a panel for each name, `PANELS` side by side."""
    lines = max(1, -(-len(names) // PANELS))
    figure = Figure(figsize=(4 * PANELS, 2.9 * lines), layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.atleast_1d(figure.subplots(lines, PANELS)).ravel()
    for name, axis in zip(names, axes, strict=False):
        draw(axis, name)
        axis.set_title(_plain(name.replace("_", " ")), fontsize=9)
        axis.tick_params(labelsize=8)
        axis.grid(alpha=0.3)
        named = axis.get_legend_handles_labels()[0]
        if named and (axis is axes[0] or every_legend):
            axis.legend(frameon=False, fontsize=7)
    for axis in axes[len(names) :]:
        axis.set_axis_off()
    return figure


def _plain(words: str) -> str:
    """Words that matplotlib takes literally: a dollar would begin a formula."""
    return words.replace("$", r"\$")
