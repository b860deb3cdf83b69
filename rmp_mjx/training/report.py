"""What a run leaves for its reader: table, eval.json, learning curve, video."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from jaxtyping import PRNGKeyArray
from rich.console import Console
from rich.table import Table

from rmp_mjx import runtime
from rmp_mjx.training import evaluate
from rmp_mjx.training.networks import Agent
from rmp_mjx.training.rollout import Env

GROUPS = ("episode/", "per_1000_steps/")
HIDDEN = ("episode/finished",)


def write_json(values: dict[str, Any], path: Path) -> None:
    """Write an evaluation's summary."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values, indent=2) + "\n")


def _number(value: Any) -> str:
    if isinstance(value, int) or abs(value) >= 1000.0:
        return f"{value:,.0f}"
    return f"{value:.4g}"


def table(summary: dict[str, Any], title: str) -> Table:
    """A terminal table of a summary; intervals stand beside their values."""
    shown = Table(title=title)
    shown.add_column("measure")
    shown.add_column("value", justify="right")
    shown.add_column("95 % interval", justify="right")
    for name, value in summary.items():
        if isinstance(value, (int, float)):
            bounds = summary.get(f"{name}_ci95")
            interval = " .. ".join(map(_number, bounds)) if bounds else ""
            shown.add_row(name, _number(value), interval)
    return shown


def plot_learning_curve(metrics: Path, picture: Path, title: str) -> None:
    """Plot every per-episode mean and event rate over the policy steps.

    Args:
        metrics: Parquet file of a run.
        picture: PNG file to write.
        title: Heading.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = pl.read_parquet(metrics)
    names = [n for n in rows.columns if n.startswith(GROUPS) and n not in HIDDEN]
    columns = 3
    lines = -(-len(names) // columns)
    figure = Figure(figsize=(4 * columns, 2.4 * lines), layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.atleast_1d(figure.subplots(lines, columns)).ravel()
    for name, axis in zip(names, axes, strict=False):
        shown = rows.select("steps", name).drop_nulls()
        axis.plot(shown["steps"], shown[name], lw=1.2)
        axis.set_title(name.replace("_", " "), fontsize=9)
        axis.tick_params(labelsize=8)
        axis.grid(alpha=0.3)
    for axis in axes[len(names) :]:
        axis.set_axis_off()
    for axis in axes[max(0, len(names) - columns) : len(names)]:
        axis.set_xlabel("policy steps", fontsize=8)
    figure.suptitle(title, fontsize=10)
    figure.savefig(picture, dpi=120)


def write_video(frames: Sequence[np.ndarray], path: Path, fps: float) -> None:
    """Write frames (h, w, 3) uint8 as an MP4, with the bundled encoder."""
    import imageio_ffmpeg
    import mediapy

    mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    mediapy.write_video(str(path), frames, fps=fps)


def film(
    env: Env, agent: Agent, key: PRNGKeyArray, path: Path, console: Console, render: Any
) -> None:
    """Render one episode to a video, or say in one line why there is none.

    Args:
        env: Single environment.
        agent: Batched agent.
        key: Randomness of the start and the actions.
        path: MP4 file to write.
        console: Terminal.
        render: Called as `render(env, states)`; gives frames (h, w, 3) uint8.
    """
    if runtime.choose_gl() is None:
        console.print("no video: no headless rendering here (neither EGL nor OSMesa)")
        return
    try:
        frames = render(env, evaluate.record_episode(env, agent, key))
        write_video(frames, path, fps=1.0 / env.dt)
    except Exception as error:  # graphics stacks fail in many ways; numbers are safe
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        console.print(f"no video: {reason}", markup=False, highlight=False)
    else:
        console.print(f"video: {path}", markup=False, highlight=False)
