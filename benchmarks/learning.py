"""Controllers trained with the same settings: the README's curves and tables.

`python -m benchmarks.learning --env door --seeds 0 1` runs `train.py` for every
controller and seed (finished runs in the folder are read, not repeated), then writes a
figure and a JSON file.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.common import ROOT, machine

CONTROLLERS = {
    "vices": ("VICES", "#c0504d"),
    "rmp_vices": ("RMP-VICES", "#2a6fbb"),
    "rmp_vices_literal": ("the paper's formulas, signs corrected", "#d9a13b"),
}
PROGRESS = {
    "trajectory": ("per_1000_steps/via_points", "via points per 1,000 steps"),
    "door": ("episode/door_angle", "largest hinge angle [rad]"),
    "push": ("episode/goal_distance", "last distance of block and goal [m]"),
}
"""What shows a task's progress best."""
PANELS = (
    ("episode/success", "success of finished episodes"),
    ("episode/return", "return of finished episodes"),
    ("cumulative/collision", "collisions, total"),
    ("cumulative/joint_limit", "joint-limit events, total"),
    ("per_1000_steps/joint_limit", "joint-limit events per 1,000 steps"),
)


def train(env: str, controller: str, seed: int, folder: Path, steps: int) -> float:
    """Train one run unless it is there; wall time of the whole process [s]."""
    timing = folder / "wall_s.json"
    if not timing.exists():
        command = [sys.executable, "train.py", "--env", env, "--controller", controller]
        command += ["--seed", str(seed), "--num_timesteps", str(steps)]
        command += ["--run_dir", str(folder), "--overwrite", "--no-video"]
        start = time.monotonic()
        subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        timing.write_text(json.dumps(time.monotonic() - start))
    return float(json.loads(timing.read_text()))


def events(metrics: pl.DataFrame) -> dict[str, float]:
    """Events of a whole training run and the episodes that finished in it."""
    steps = metrics["steps"].diff().fill_null(metrics["steps"][0]).to_numpy()
    total = {
        name: float(np.sum(metrics[f"per_1000_steps/{name}"].to_numpy() * steps / 1e3))
        for name in ("collision", "self_collision", "joint_limit")
    }
    return total | {
        "episodes": float(metrics["episode/finished"].sum()),
        "steps": float(metrics["steps"][-1]),
    }


def curve(metrics: pl.DataFrame, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps and values of one panel."""
    if name.startswith("cumulative/"):
        rate = metrics["per_1000_steps/" + name.removeprefix("cumulative/")]
        steps = metrics["steps"].diff().fill_null(metrics["steps"][0])
        return metrics["steps"].to_numpy(), np.cumsum(rate * steps / 1e3)
    shown = metrics.select("steps", name).drop_nulls()
    return shown["steps"].to_numpy(), shown[name].to_numpy()


def plot(env: str, runs: dict[str, list[pl.DataFrame]], path: Path) -> None:
    """One panel per measure, one line per run."""
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3).ravel()
    for axis, (name, title) in zip(axes, (PROGRESS[env], *PANELS), strict=True):
        for controller, frames in runs.items():
            label, color = CONTROLLERS[controller]
            for i, frame in enumerate(frames):
                x, y = curve(frame, name)
                axis.plot(x / 1e3, y, color=color, lw=1.3, label=None if i else label)
        axis.set_title(title, fontsize=10)
        axis.grid(alpha=0.3)
        axis.tick_params(labelsize=8)
    for axis in axes[3:]:
        axis.set_xlabel("policy steps [thousands]", fontsize=9)
    axes[0].legend(frameon=False, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main(args: Sequence[str] | None = None) -> None:
    """Train what is missing, then write figure and JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", choices=tuple(PROGRESS), default="trajectory")
    parser.add_argument(
        "--controllers",
        choices=tuple(CONTROLLERS),
        nargs="+",
        default=["vices", "rmp_vices"],
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--num_timesteps", type=int, default=400_000)
    parser.add_argument("--folder", type=Path, default=Path("runs/learning"))
    parser.add_argument("--plot", type=Path, help="docs/img/learning_ENV.png")
    parser.add_argument(
        "--json", type=Path, help="benchmarks/results/learning_ENV.json"
    )
    options = parser.parse_args(args)
    env = options.env
    picture = options.plot or Path(f"docs/img/learning_{env}.png")
    results_file = options.json or Path(f"benchmarks/results/learning_{env}.json")
    runs: dict[str, list[pl.DataFrame]] = {}
    results: list[dict[str, Any]] = []
    for controller in options.controllers:
        for seed in options.seeds:
            folder = (options.folder / f"{env}-{controller}-seed{seed}").absolute()
            wall = train(env, controller, seed, folder, options.num_timesteps)
            metrics = pl.read_parquet(folder / "metrics.parquet")
            runs.setdefault(controller, []).append(metrics)
            evaluation = json.loads((folder / "eval.json").read_text())
            results.append(
                {
                    "controller": controller,
                    "seed": seed,
                    "wall_s": round(wall, 1),
                    "training": events(metrics),
                    "evaluation": evaluation,
                }
            )
    plot(env, runs, picture)
    document = {
        "env": env,
        "command": " ".join(["python", "-m", "benchmarks.learning", *sys.argv[1:]]),
        "machine": machine(),
        "num_timesteps": options.num_timesteps,
        "runs": results,
    }
    results_file.parent.mkdir(parents=True, exist_ok=True)
    results_file.write_text(json.dumps(document, indent=2) + "\n")
    for run in results:
        print(
            run["controller"],
            f"seed {run['seed']}: {run['wall_s']:.0f} s,",
            f"success {run['evaluation']['success_rate']:.0%},",
            f"collisions {run['training']['collision']:.0f},",
            f"joint limits {run['training']['joint_limit']:.0f}",
        )


if __name__ == "__main__":
    main()
