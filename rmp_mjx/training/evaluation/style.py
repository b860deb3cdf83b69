"""The look that all plots of a run share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

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
