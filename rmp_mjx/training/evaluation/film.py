"""Pictures of recorded episodes: an instance, a storyboard, a video of a grid."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from rich.console import Console

from rmp_mjx import runtime
from rmp_mjx.training.evaluation.recording import Recording
from rmp_mjx.training.runs import run_folder
from rmp_mjx.video import write_video

Frame = UInt8[np.ndarray, "h w 3"]
Draw = Callable[[Sequence[Any], tuple[int, int], bool], list[Frame]]
"""States of one environment, a size (height, width) and whether there are shadows, to a
frame each."""

EPISODES = 9
"""Episodes in the video."""
STILLS = 6
"""Stills in the storyboard."""
LARGE, SMALL = (480, 640), (240, 320)
"""Height and width of a picture of its own and of one in a row or grid [pixels]."""
STRIDE = 2
"""Policy steps from one frame of the video to the next."""


def publish(
    draw: Draw, recording: Recording, dt: float, folder: Path, console: Console
) -> None:
    """Write `instance.png`, `storyboard.png` and `video.mp4`, or say why not.

    Args:
        draw: The environment's renderer.
        recording: Episodes; the first is on the instance and the storyboard.
        dt: Time of a policy step [s].
        folder: Where the files go.
        console: Terminal.
    """
    if runtime.choose_gl() is None:
        console.print(
            "no pictures: no headless rendering here (neither EGL nor OSMesa)"
        )
        return
    try:
        import mediapy

        (instance,) = draw([recording.state(0, 0)], LARGE, True)
        mediapy.write_image(folder / run_folder.INSTANCE, instance)
        stills = storyboard(draw, recording)
        mediapy.write_image(folder / run_folder.STORYBOARD, stills)
        video = grid(draw, recording)
        write_video(folder / run_folder.VIDEO, video, 1.0 / (STRIDE * dt))
    except Exception as error:  # graphics stacks fail in many ways; numbers are safe
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        console.print(f"no pictures: {reason}", markup=False, highlight=False)


def storyboard(draw: Draw, recording: Recording) -> Frame:
    """Regularly timed stills of the first episode, start and end included, in a row."""
    steps = np.linspace(0, recording.lengths[0], STILLS).round().astype(int)
    stills = draw([recording.state(0, int(t)) for t in steps], SMALL, True)
    return np.concatenate(stills, axis=1)


def grid(draw: Draw, recording: Recording) -> list[Frame]:
    """Episodes side by side; one that has ended keeps its last frame."""
    times = [[*range(0, int(n), STRIDE), int(n)] for n in recording.lengths]
    states = [recording.state(k, t) for k, row in enumerate(times) for t in row]
    drawn = draw(states, SMALL, False)
    ends = np.cumsum([len(row) for row in times])
    lanes = [drawn[end - len(row) : end] for row, end in zip(times, ends, strict=True)]
    columns = math.ceil(math.sqrt(recording.count))
    lanes += [[np.zeros_like(drawn[0])]] * (-recording.count % columns)
    frames = []
    for t in range(max(map(len, times))):
        tiles = [lane[min(t, len(lane) - 1)] for lane in lanes]
        rows = [tiles[i : i + columns] for i in range(0, len(tiles), columns)]
        frames.append(np.concatenate([np.concatenate(r, axis=1) for r in rows]))
    return frames
