"""Histograms of an evaluation's episodes: contact forces and clearances."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from rmp_mjx.training.evaluation import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FORCES = np.geomspace(0.1, 1e4, 26).tolist()
"""Bins of the force histogram, five a decade [N]."""
COLORS = (style.RUN, style.OTHER)
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
    with style.page(picture, 1, 1, SIZE) as (figure, (axis,)):
        for (name, values), color in zip(touched.items(), COLORS, strict=False):
            label = f"{name}: contact in {len(values)} of {len(peaks[name])} episodes"
            clipped = np.clip(values, FORCES[0], FORCES[-1])
            axis.hist(clipped, FORCES, alpha=0.6, color=color, label=label)
        if not any(map(len, touched.values())):
            episodes = " + ".join(str(len(values)) for values in peaks.values())
            style.say(axis, f"no contact in {episodes} episodes")
        axis.set_xscale("log")
        axis.set_xlim(FORCES[0], FORCES[-1])
        axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,g}"))
        axis.set_title("Greatest contact force of an episode [N]")
        _finish(axis)
        style.heading(figure, title)


def plot_clearances(
    clearances: Mapping[str, Float[np.ndarray, " n"]], picture: Path, title: str
) -> None:
    """Histogram of each episode's least clearance; 0 is contact.

    Args:
        clearances: Least clearance of each episode by engine [m].
        picture: PNG file to write.
        title: Heading.
    """
    with style.page(picture, 1, 1, SIZE) as (figure, (axis,)):
        values = [1e3 * x for x in clearances.values()]
        low, high = min(map(np.min, values)), max(map(np.max, values))
        bins = np.linspace(min(low, 0.0), max(high, 1.0), 31).tolist()
        for name, x, color in zip(clearances, values, COLORS, strict=False):
            label = f"{name}: median {np.median(x):.0f} mm, least {np.min(x):.1f} mm"
            axis.hist(x, bins, alpha=0.6, color=color, label=label)
        axis.axvline(0.0, ymax=1.0 / HEADROOM, color=style.INK, lw=1.0)
        axis.set_title("Least clearance of an episode [mm]; 0 is contact")
        _finish(axis)
        style.heading(figure, title)


def _finish(axis: Axes) -> None:
    """Give the axis whole numbers of episodes, and room for the legend."""
    from matplotlib.ticker import MaxNLocator

    axis.set_ylabel("episodes")
    axis.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axis.set_ylim(0.0, HEADROOM * max(1.0, axis.get_ylim()[1]))
    axis.legend(loc="upper left")
