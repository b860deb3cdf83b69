"""Figures from the store."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import polars as pl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread

from benchmarks.paper import deployment, measures, targets
from benchmarks.paper.cells import COLUMNS, PAPER, TABLE, TASKS, VARIANTS, Cell
from benchmarks.paper.store import Store
from benchmarks.png import save_figure

PANELS = {
    "episode/return": "return per episode",
    "episode/collision": "collisions per episode",
    "episode/joint_limit": "joint-limit events per episode",
}
"""Rows of the training figure."""
COUNTS = ("episode/collision", "episode/joint_limit")
"""Those that cannot be negative."""
FORCES = np.geomspace(0.1, 1e4, 26)
"""Bins of a force histogram, five a decade [N]."""


@contextmanager
def _figure(
    path: Path, lines: int, columns: int, size: tuple[float, float]
) -> Iterator[tuple[Figure, np.ndarray]]:
    """Axes (lines, columns) of a figure that is written as PNG."""
    figure = Figure(figsize=(size[0] * columns, size[1] * lines), layout="constrained")
    FigureCanvasAgg(figure)
    yield figure, figure.subplots(lines, columns, squeeze=False)
    save_figure(figure, path)


def training(place: Store, path: Path, variants: Sequence[str] = PAPER) -> None:
    """The nine training panels: mean over the seeds, 95 % band."""
    with _figure(path, len(PANELS), len(TASKS), (4.2, 2.6)) as (_, axes):
        for column, (task, title) in enumerate(TASKS.items()):
            for line, (name, label) in enumerate(PANELS.items()):
                axis = axes[line, column]
                for variant in variants:
                    rows = measures.of(place.training, task=task, variant=variant)
                    if not rows.is_empty():
                        curves = measures.curves(rows, name)
                        _curve(axis, curves, variant, name in COUNTS)
                if line == 0:
                    axis.set_title(title, fontsize=10)
                if column == 0:
                    axis.set_ylabel(label, fontsize=9)
                axis.grid(alpha=0.3)
                axis.tick_params(labelsize=8)
            axes[-1, column].set_xlabel("policy steps [thousands]", fontsize=9)
        _legend(axes[0, 0])


def _curve(axis, curves: measures.Curves, variant: str, count: bool) -> None:
    mean, (low, high) = measures.band(curves.values)
    low = np.maximum(low, 0.0) if count else low
    x, style = curves.steps / 1e3, VARIANTS[variant]
    seeds = len(curves.seeds)
    label = f"{style.label}, {seeds} seed{'s' if seeds > 1 else ''}"
    axis.plot(x, mean, color=style.color, lw=1.3, label=label)
    axis.fill_between(x, low, high, color=style.color, alpha=0.2, lw=0)


def _legend(axis) -> None:
    if axis.get_legend_handles_labels()[0]:
        axis.legend(frameon=False, fontsize=8)


def forces(place: Store, path: Path, column: str) -> None:
    """The five force histograms: training in door and push, deployment in all."""
    trained = ("door", "push")
    with _figure(path, 1, len(trained) + len(TASKS), (3.4, 2.8)) as (_, axes):
        for axis, task in zip(axes[0], trained, strict=False):
            for variant in PAPER:
                rows = measures.of(place.training, task=task, variant=variant)
                if not rows.is_empty():
                    _histogram(axis, *measures.training_forces(rows), variant)
            axis.set_title(f"training: {TASKS[task]}", fontsize=9)
        for axis, task in zip(axes[0, len(trained) :], TASKS, strict=True):
            for variant in PAPER:
                rows = targets.best(place, task, variant, column)
                if rows is not None:
                    peaks = rows["contact_force_peak"].to_numpy()
                    peaks = peaks[peaks > 0.0]
                    _histogram(axis, peaks, np.ones_like(peaks), variant)
            axis.set_title(f"deployed: {TASKS[task]}", fontsize=9)
        for axis in axes[0]:
            axis.set_xscale("log")
            axis.set_xlim(FORCES[0], FORCES[-1])
            axis.set_xlabel("greatest contact force [N]", fontsize=8)
            axis.tick_params(labelsize=8)
            axis.set_ylim(0.0, 1.35 * max(1.0, axis.get_ylim()[1]))
            axis.grid(alpha=0.3)
            _legend(axis)
        axes[0, 0].set_ylabel("episodes", fontsize=9)


def _histogram(axis, values: np.ndarray, number: np.ndarray, variant: str) -> None:
    style = VARIANTS[variant]
    label = f"{style.label}: {number.sum():.0f}"
    shown = np.clip(values, FORCES[0], FORCES[-1])
    axis.hist(shown, FORCES, weights=number, alpha=0.6, color=style.color, label=label)


def pareto(place: Store, path: Path) -> None:
    """Success against safety of every variant's best seed, layout by layout."""
    with _figure(path, len(TABLE), len(TASKS), (3.8, 3.0)) as (_, axes):
        for line, name in enumerate(TABLE):
            for axis, (task, title) in zip(axes[line], TASKS.items(), strict=True):
                sizes = np.linspace(10.0, 4.0, len(VARIANTS))  # none hides another
                for (variant, style), size in zip(VARIANTS.items(), sizes, strict=True):
                    rows = targets.best(place, task, variant, name)
                    if rows is None:
                        continue
                    point = [measures.ended(rows), measures.rate(rows, "success")]
                    (x, dx), (y, dy) = ((r.percent, _bars(r)) for r in point)
                    axis.errorbar(
                        *(x, y, dy, dx),
                        fmt="o",
                        markersize=size,
                        color=style.color,
                        capsize=2,
                        lw=1,
                        label=style.label,
                    )
                axis.set_title(f"{title}, {COLUMNS[name].label}", fontsize=9)
                axis.set_xlim(-3, 103)
                axis.set_ylim(-3, 103)
                axis.invert_xaxis()  # safe is right, able is up
                axis.grid(alpha=0.3)
                axis.tick_params(labelsize=8)
        for axis in axes[-1]:
            axis.set_xlabel("episodes ended by an event [%]", fontsize=9)
        for axis in axes[:, 0]:
            axis.set_ylabel("success [%]", fontsize=9)
        _legend(axes[0, 0])


def _bars(rate: measures.Rate) -> np.ndarray:
    """Lengths of the error bars, (2, 1)."""
    low, high = rate.interval
    return np.array([[rate.percent - low], [high - rate.percent]])


def robustness(place: Store, path: Path, names: Sequence[str]) -> None:
    """Success and events of the paper's variants in every column."""
    rows = {"success": measures.rate, "event": lambda found, _: measures.ended(found)}
    with _figure(path, len(rows), len(TASKS), (4.2, 2.6)) as (_, axes):
        for line, (name, measure) in enumerate(rows.items()):
            for axis, (task, title) in zip(axes[line], TASKS.items(), strict=True):
                for shift, variant in enumerate(PAPER):
                    for k, column in enumerate(names):
                        found = targets.best(place, task, variant, column)
                        if found is None:
                            continue
                        rate = measure(found, name)
                        axis.errorbar(
                            k + 0.2 * shift - 0.1,
                            rate.percent,
                            _bars(rate),
                            fmt="o",
                            color=VARIANTS[variant].color,
                            capsize=2,
                            ms=4,
                            label=None if k else VARIANTS[variant].label,
                        )
                labels = [COLUMNS[column].label for column in names] if line else []
                axis.set_xticks(range(len(names)), labels or [""] * len(names))
                axis.tick_params(axis="x", rotation=60, labelsize=8)
                axis.set_ylim(-3, 103)
                axis.grid(alpha=0.3)
                axis.set_title("" if line else title, fontsize=10)
        axes[0, 0].set_ylabel("success [%]", fontsize=9)
        axes[1, 0].set_ylabel("ended by an event [%]", fontsize=9)
        _legend(axes[0, 0])


def best_cell(place: Store, task: str, variant: str) -> Cell | None:
    """The best seed of a task and variant; None where none is trained."""
    rows = measures.of(place.training, task=task, variant=variant)
    return None if rows.is_empty() else Cell(task, variant, measures.best_seed(rows))


def best_events(place: Store) -> pl.DataFrame:
    """Recorded events of the best seeds."""
    if place.events.is_empty():
        return place.events
    chosen = [
        measures.of(place.events, task=task, variant=variant, seed=cell.seed)
        for task in TASKS
        for variant in VARIANTS
        if (cell := best_cell(place, task, variant))
    ]
    return pl.concat(chosen)


def montage(images: Sequence[tuple[str, Path]], path: Path, columns: int) -> bool:
    """Pictures with their titles in a grid; True where there is one.

    A packed store has no pictures: then a figure of some that was drawn before is kept.
    """
    found = [(title, path) for title, path in images if path.exists()]
    if not found:
        return bool(images) and path.exists()
    sizes = [imread(image) for _, image in found]
    height, width = sizes[0].shape[:2]
    cell = (12.0 / columns, 12.0 / columns * height / width + 0.25)
    lines = -(-len(found) // columns)
    with _figure(path, lines, columns, cell) as (_, axes):
        for axis in axes.flat:
            axis.set_axis_off()
        for axis, (title, _), image in zip(axes.flat, found, sizes, strict=False):
            axis.imshow(image)
            axis.set_title(title, fontsize=9)
    return True


def instances(place: Store, path: Path) -> bool:
    """A deployed start of every task, obstacles included."""
    images = []
    for task, title in TASKS.items():
        cell = best_cell(place, task, targets.OURS)
        if cell:
            images.append((title, deployment.folder(place, cell) / deployment.INSTANCE))
    return montage(images, path, 3)


def storyboard(place: Store, path: Path, task: str) -> bool:
    """Regularly timed stills of one episode of each of the paper's variants."""
    images = []
    for variant in PAPER:
        cell = best_cell(place, task, variant)
        if cell:
            image = deployment.folder(place, cell) / deployment.STORYBOARD
            images.append((VARIANTS[variant].label, image))
    return montage(images, path, 1)


def failures(place: Store, path: Path, events: pl.DataFrame) -> bool:
    """The ends of the best seeds' first failed episodes, ours."""
    images = []
    for task, title in TASKS.items():
        cell = best_cell(place, task, targets.OURS)
        if cell is None:
            continue
        rows = measures.of(events, task=task, variant=cell.variant, seed=cell.seed)
        for number, row in enumerate(rows.iter_rows(named=True)):
            still = deployment.folder(place, cell) / deployment.failure(number)
            images.append((f"{title}: {row['first']} and {row['second']}", still))
    return montage(images, path, 3)
