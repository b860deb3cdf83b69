"""Frames as an MP4, with the encoder that the extra `plots` brings."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8


def write_video(path: Path, frames: Sequence[UInt8[np.ndarray, "h w 3"]], fps: float):
    """Write an MP4.

    Args:
        path: The file; its folder must exist.
        frames: Pictures, one after the other.
        fps: Pictures per second.

    Raises:
        ImportError: The extra `plots` is not installed.
    """
    import imageio_ffmpeg
    import mediapy

    mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    mediapy.write_video(path, frames, fps=fps)
