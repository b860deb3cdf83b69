"""A film of the last seconds: an MP4 of what MuJoCo draws without a screen."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import mujoco
import numpy as np

from rmp_mjx import runtime
from rmp_mjx.video import write_video
from rmp_mjx.viewer.player import FrameT, Simulation

SECONDS = 10.0
"""Length of a film [s]."""
RATE = 25.0
"""Pictures per second, at most."""
SIZE = (480, 640)
"""Height and width of a picture [pixels]."""


def sampled(simulation: Simulation[FrameT]) -> tuple[list[FrameT], float]:
    """The frames of a film, and how many there are in a second."""
    stride = max(round(1.0 / (RATE * simulation.period)), 1)
    kept = round(SECONDS / simulation.period)
    frames = list(simulation.history)[-kept:]
    return frames[::-stride][::-1], 1.0 / (stride * simulation.period)


def make(
    simulation: Simulation[FrameT],
    draw: Callable[[Sequence[FrameT]], list[np.ndarray]],
    folder: Path,
) -> Path:
    """Draw the last seconds, and write them.

    Args:
        simulation: Has the frames.
        draw: Draws frames, (height, width, 3) each.
        folder: Where the file goes; it is made if it is not there.

    Returns:
        The file.

    Raises:
        ValueError: Nothing was shown yet, or no film can be made here.
    """
    frames, fps = sampled(simulation)
    if not frames:
        raise ValueError("nothing was shown yet: a film is of the last seconds")
    if runtime.choose_gl() is None:
        raise ValueError("no film: no headless rendering here, neither EGL nor OSMesa")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / time.strftime("%Y-%m-%d-%H%M%S.mp4")
    try:
        write_video(path, draw(frames), fps)
    except ImportError as error:
        raise ValueError(f"no film: install the extra plots ({error})") from error
    except (OSError, RuntimeError, mujoco.FatalError) as error:
        raise ValueError(f"no film: {error}") from error
    return path


def lit(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of a model without lamps that can be seen: bright, its planes light."""
    model = copy.copy(model)
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.6, 0.6
    model.geom_rgba[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE] = [0.8] * 3 + [1.0]
    return model


def camera(eye: np.ndarray, middle: np.ndarray) -> mujoco.MjvCamera:
    """MuJoCo's camera at a place, looking at another one [m]."""
    ahead = np.asarray(middle, float) - np.asarray(eye, float)
    found = mujoco.MjvCamera()
    found.lookat[:] = middle
    found.distance = np.linalg.norm(ahead)
    found.azimuth = np.rad2deg(np.arctan2(ahead[1], ahead[0]))
    found.elevation = np.rad2deg(np.arcsin(ahead[2] / found.distance))
    return found
