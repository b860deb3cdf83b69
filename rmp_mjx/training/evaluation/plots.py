"""The look that all plots of a run share, and the histograms of an evaluation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RUN, OTHER = "#2a6fbb", "#c0504d"
"""Colours of the run (or of its own engine) and of what it is compared with."""
INK, GREY = "#222222", "#6b6b6b"
"""Colours of words: headings, and everything else."""
DPI = 120
"""Pixels per inch of a figure: 10 inches are 1200 pixels."""
NICE = (1, 2, 2.5, 5, 10)
"""Multiples at which an axis may have its numbers."""

_RC: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.labelsize": 9.0,
    "axes.labelcolor": GREY,
    "axes.edgecolor": "#b0b0b0",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.axisbelow": True,
    "grid.color": "#e6e6e6",
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.frameon": False,
    "legend.fontsize": 9.0,
}


@contextmanager
def page(
    path: Path, rows: int, columns: int, size: tuple[float, float]
) -> Iterator[tuple[Figure, list[Axes]]]:
    """A figure of `rows` x `columns` panels that is written to `path` in the end.

    Args:
        path: PNG file.
        rows: Rows of panels.
        columns: Columns of panels.
        size: Width and height [inches].

    Yields:
        The figure and its panels, row by row.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(_RC):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(rows, columns, squeeze=False)
        yield figure, list(axes.ravel())
        figure.savefig(path, dpi=DPI)


def heading(figure: Figure, title: str) -> None:
    """Put a title above all panels, at the left."""
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, color=INK, weight="bold")


def caption(figure: Figure, text: str) -> None:
    """Put an explanation below all panels, at the left."""
    figure.supxlabel(text, x=0.01, ha="left", fontsize=8.5, color=GREY)


def steps(count: float, last: float = 0.0, digits: int = 3) -> str:
    """A number of policy steps: 500, 30k, 1.5M.

    Args:
        count: The number.
        last: The last step of the axis that it is on; decides between k and M.
        digits: Digits that are shown.
    """
    largest = max(count, last)
    unit, suffix = next(
        (found for found in ((1e6, "M"), (1e3, "k")) if largest >= found[0]), (1.0, "")
    )
    return f"{count / unit:.{digits}g}{suffix}" if count else "0"


def finish(axis: Axes, title: str, last: float) -> None:
    """Finish a panel of curves over policy steps.

    The vertical axis starts at 0 if nothing on it is negative. A panel without values
    says so.

    Args:
        axis: The panel.
        title: Its title.
        last: The last policy step.
    """
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    axis.set_title(title)
    axis.set_xlim(0.0, last)
    axis.xaxis.set_major_locator(MaxNLocator(5, steps=NICE))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: steps(x, last)))
    axis.yaxis.set_major_locator(MaxNLocator(5, steps=NICE))
    axis.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:,.6g}"))
    values = np.concatenate([[], *(np.asarray(x.get_ydata()) for x in axis.lines)])
    if not len(values):
        axis.set_yticks([])
        say(axis, "no episode has finished")
    elif values.min() >= 0.0:
        axis.set_ylim(bottom=0.0)


def say(axis: Axes, text: str) -> None:
    """Write into the middle of a panel that has nothing to show."""
    place = axis.transAxes
    axis.text(0.5, 0.5, text, color=GREY, ha="center", va="center", transform=place)


def tidy(axes: Sequence[Axes], used: int, wide: int) -> None:
    """Hide the panels that are not used; name the horizontal axis once a column."""
    for axis in axes[used:]:
        axis.set_axis_off()
    for axis in axes[max(0, used - wide) : used]:
        axis.set_xlabel("policy steps")


if TYPE_CHECKING:
    from matplotlib.axes import Axes

FORCES = np.geomspace(0.1, 1e4, 26).tolist()
"""Bins of the force histogram, five a decade [N]."""
COLORS = (RUN, OTHER)
"""One for each engine."""
SIZE = (6.5, 3.6)
"""Width and height of a histogram [inches]."""
HEADROOM = 1.3
"""Height of the axis over that of the highest bar: room for the legend."""


def plot_forces(
    peaks: Mapping[str, Float[np.ndarray, " n"]], picture: Path, title: str
) -> None:
    """Histogram of the greatest contact force of each episode that had a contact.

    Args:
        peaks: Greatest force of each episode by engine [N]; 0 without a contact.
        picture: PNG file to write.
        title: Heading.
    """
    from matplotlib.ticker import FuncFormatter

    touched = {name: values[values > 0.0] for name, values in peaks.items()}
    with page(picture, 1, 1, SIZE) as (figure, (axis,)):
        for (name, values), color in zip(touched.items(), COLORS, strict=False):
            label = f"{name}: contact in {len(values)} of {len(peaks[name])} episodes"
            clipped = np.clip(values, FORCES[0], FORCES[-1])
            axis.hist(clipped, FORCES, alpha=0.6, color=color, label=label)
        if not any(map(len, touched.values())):
            episodes = " + ".join(str(len(values)) for values in peaks.values())
            say(axis, f"no contact in {episodes} episodes")
        axis.set_xscale("log")
        axis.set_xlim(FORCES[0], FORCES[-1])
        axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,g}"))
        axis.set_title("Greatest contact force of an episode [N]")
        _finish(axis)
        heading(figure, title)


def plot_clearances(
    clearances: Mapping[str, Float[np.ndarray, " n"]], picture: Path, title: str
) -> None:
    """Histogram of each episode's least clearance; 0 is contact.

    Args:
        clearances: Least clearance of each episode by engine [m].
        picture: PNG file to write.
        title: Heading.
    """
    with page(picture, 1, 1, SIZE) as (figure, (axis,)):
        values = [1e3 * x for x in clearances.values()]
        low, high = min(map(np.min, values)), max(map(np.max, values))
        bins = np.linspace(min(low, 0.0), max(high, 1.0), 31).tolist()
        for name, x, color in zip(clearances, values, COLORS, strict=False):
            label = f"{name}: median {np.median(x):.0f} mm, least {np.min(x):.1f} mm"
            axis.hist(x, bins, alpha=0.6, color=color, label=label)
        axis.axvline(0.0, ymax=1.0 / HEADROOM, color=INK, lw=1.0)
        axis.set_title("Least clearance of an episode [mm]; 0 is contact")
        _finish(axis)
        heading(figure, title)


def _finish(axis: Axes) -> None:
    """Give the axis whole numbers of episodes, and room for the legend."""
    from matplotlib.ticker import MaxNLocator

    axis.set_ylabel("episodes")
    axis.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axis.set_ylim(0.0, HEADROOM * max(1.0, axis.get_ylim()[1]))
    axis.legend(loc="upper left")
