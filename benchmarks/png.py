"""Figures for the repository: one PNG file each, as small as its look allows."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

COLORS = 256
"""Colours of a picture with a palette: a third of the bytes of one without."""
NEARLY_WHITE = 252
"""What the octree makes of white is at least this in every channel."""


def save_figure(figure: Figure, path: Path, dpi: int = 120) -> None:
    """Write a figure as a PNG file with a palette.

    Args:
        figure: The figure.
        path: The file; its folder is made.
        dpi: Pixels per inch.
    """
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=dpi)
    path.parent.mkdir(parents=True, exist_ok=True)
    shrink(Image.open(data)).save(path, optimize=True)


def shrink(picture: Image.Image) -> Image.Image:
    """The picture with a palette of its own; the octree keeps small bright things."""
    small = picture.convert("RGB").quantize(
        COLORS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE
    )
    colors = np.array(small.getpalette(), np.uint8).reshape(-1, 3)
    colors[colors.min(axis=1) >= NEARLY_WHITE] = 255
    small.putpalette(colors.tobytes())
    return small
