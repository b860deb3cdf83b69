"""Compare runs: `python -m benchmarks.report RUN... --out page.html`.

Runs that differ in their seed alone form a group. The page needs no other file: curves
with 95 % intervals over the seeds, safety figures, a table, and what differs between
the groups' configurations.
"""

from __future__ import annotations

import argparse
import base64
import html
import io
import json
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from envs.flags import load_config
from rmp_mjx.training.config import TrainConfig, defining
from rmp_mjx.training.evaluation.figures import curves
from rmp_mjx.training.runs import run_folder
from rmp_mjx.training.runs.metrics import SEED, over_seeds
from rmp_mjx.training.stats import bootstrap_mean, clopper_pearson

COLORS = ("#2a6fbb", "#c0504d", "#d9a13b", "#4f9d69", "#7d5ba6", "#5b5b5b")
"""One for each group, over and over."""
SEEDS = ("seed", "num_seeds")
"""Options in which the runs of a group may differ."""
FIRST = ("episode/return", "episode/success")
"""Curves that a reader wants first."""
EVENTS = ("collision", "self_collision", "joint_limit")
"""Safety events that are counted, where the tasks have them."""
MEASURES = (
    ("return_mean", "return", 1.0),
    ("success_rate", "success [%]", 100.0),
    ("collision_rate", "collision [%]", 100.0),
    ("joint_limit_rate", "joint limit [%]", 100.0),
    ("contact_force_peak_max", "worst contact [N]", 1.0),
    ("clearance_mean", "least clearance [mm]", 1e3),
)
"""Columns of the table from a run's evaluation: name, heading, factor."""
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 68rem;
  padding: 0 1rem; color: #222; }
table { border-collapse: collapse; margin: 1rem 0; }
th, td { padding: .25rem .7rem; border-bottom: 1px solid #ddd; text-align: right; }
th:first-child, td:first-child { text-align: left; }
img { max-width: 100%; }
code { background: #f3f3f3; padding: 0 .2em; }
"""


@dataclass(frozen=True)
class Run:
    """What a run folder says about one seed."""

    folder: Path
    """Folder of the run."""
    config: TrainConfig
    """Its configuration."""
    seed: int
    """The seed."""
    rows: pl.DataFrame
    """Its rows, with the seed as a column."""
    evaluation: dict[str, Any]
    """Its evaluation; empty where there is none."""


@dataclass(frozen=True)
class Group:
    """Runs that differ in their seed alone."""

    name: str
    """How the page calls it."""
    color: str
    """Its colour."""
    runs: list[Run]
    """The runs, one a seed."""

    @property
    def rows(self) -> pl.DataFrame:
        """The rows of all runs; the same seed twice counts as two."""
        frames = (
            run.rows.with_columns(pl.lit(k).alias(SEED))
            for k, run in enumerate(self.runs)
        )
        return pl.concat(list(frames), how="diagonal_relaxed")

    def counted(self, event: str) -> tuple[int, int]:
        """Evaluation episodes with an event, and all of them."""
        name = f"{event}_episodes"
        found = [r.evaluation for r in self.runs if name in r.evaluation]
        return sum(f[name] for f in found), sum(f["episodes"] for f in found)


def read_run(folder: Path) -> list[Run]:
    """A run's seeds.

    Raises:
        ValueError: The folder is no run, or has no rows yet.
    """
    config = load_config(folder)
    path = folder / run_folder.METRICS
    if not path.exists():
        raise ValueError(f"{folder} has no rows yet: no {path.name}")
    rows = pl.read_parquet(path)
    if SEED not in rows.columns:
        rows = rows.with_columns(pl.lit(config.ppo.seed).alias(SEED))
    runs = []
    for k, place in enumerate(run_folder.seed_folders(config, folder)):
        own = rows.filter(pl.col(SEED) == config.ppo.seed + k)
        file = place / run_folder.EVALUATION
        evaluation = json.loads(file.read_text()) if file.exists() else {}
        runs.append(Run(folder, config, config.ppo.seed + k, own, evaluation))
    return runs


def grouped(runs: Iterable[Run]) -> list[Group]:
    """Runs by what defines them, in the order in which they are first named."""
    by_config: dict[str, list[Run]] = {}
    for run in runs:
        key = json.dumps(settings(run.config), sort_keys=True)
        by_config.setdefault(key, []).append(run)
    found = [runs[0].config for runs in by_config.values()]
    varying = [name for name, values in differences(found).items() if len(values) > 1]
    groups: list[Group] = []
    for members, config in zip(by_config.values(), found, strict=True):
        said = [f"{name} {_text(settings(config).get(name))}" for name in varying]
        name = ", ".join(said) or config.task.title
        groups.append(Group(name, COLORS[len(groups) % len(COLORS)], members))
    return groups


def settings(config: TrainConfig) -> dict[str, Any]:
    """What defines a run but for its seeds, by name."""
    values = defining(config.record())
    return {name: value for name, value in values.items() if name not in SEEDS}


def differences(configs: Sequence[TrainConfig]) -> dict[str, list[Any]]:
    """Options that differ between configurations, and their values."""
    found = [settings(config) for config in configs]
    names = dict.fromkeys(name for each in found for name in each)
    values = {name: [each.get(name) for each in found] for name in names}
    return {name: each for name, each in values.items() if len(set(each)) > 1}


def split_curves(groups: Sequence[Group]) -> tuple[list[str], list[str]]:
    """Columns with something to see, `FIRST` first, and those with one value alone."""
    names = dict.fromkeys(name for g in groups for name in (*FIRST, *curves(g.rows)))
    moving, flat = [], []
    for name in names:
        found = [g.rows[name].drop_nulls() for g in groups if name in g.rows.columns]
        values = {value for column in found for value in column.unique()}
        (moving if len(values) > 1 else flat).append(name)
    return moving, flat


def learning_curves(groups: Sequence[Group], names: Sequence[str]) -> Figure:
    """Interquartile means over the seeds with their intervals, a panel each."""
    bands = [
        (group, over_seeds(group.rows, _present(group, names))) for group in groups
    ]

    def draw(axis, name):
        for group, band in bands:
            if name not in band.columns:
                continue
            shown = band.select("steps", f"^{name}(_low|_high)?$").drop_nulls()
            steps, middle, low, high = (column / 1 for column in shown.get_columns())
            axis.fill_between(
                steps / 1e3, low, high, color=group.color, alpha=0.2, lw=0
            )
            axis.plot(steps / 1e3, middle, color=group.color, lw=1.4, label=group.name)
        axis.set_xlabel("policy steps [thousands]", fontsize=8)

    return _panels(names, draw)


def safety(groups: Sequence[Group]) -> Figure:
    """Share of the evaluation's episodes with an event, with exact 95 % intervals."""

    def draw(axis, event):
        for k, group in enumerate(groups):
            hits, episodes = group.counted(event)
            if not episodes:
                continue
            low, high = clopper_pearson(hits, episodes)
            share = hits / episodes
            error = [[100 * (share - low)], [100 * (high - share)]]
            label = f"{group.name}: {hits} of {episodes}"
            axis.errorbar(
                k,
                100 * share,
                error,
                fmt="o",
                color=group.color,
                capsize=4,
                label=label,
            )
        axis.set_xticks([])
        axis.set_xlim(-0.5, len(groups) - 0.5)
        axis.set_ylabel("episodes [%]", fontsize=8)
        axis.set_ylim(bottom=0.0)

    return _panels([event.replace("_", " ") for event in EVENTS], draw, EVENTS)


def _present(group: Group, names: Iterable[str]) -> list[str]:
    return [name for name in names if name in group.rows.columns]


def _panels(
    titles: Sequence[str],
    draw: Callable[[Any, str], None],
    keys: Sequence[str] | None = None,
) -> Figure:
    """A figure with three panels a line."""
    lines = max(1, -(-len(titles) // 3))
    figure = Figure(figsize=(12, 2.9 * lines), layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.atleast_1d(figure.subplots(lines, 3)).ravel()
    for title, key, axis in zip(titles, keys or titles, axes, strict=False):
        draw(axis, key)
        axis.set_title(title.replace("_", " "), fontsize=9)
        axis.tick_params(labelsize=8)
        axis.grid(alpha=0.3)
        if axis.get_legend_handles_labels()[0] and (axis is axes[0] or keys):
            axis.legend(frameon=False, fontsize=7)
    for axis in axes[len(titles) :]:
        axis.set_axis_off()
    return figure


def table(groups: Sequence[Group]) -> list[list[str]]:
    """Heading and a line for each group: means over the seeds with 95 % intervals."""
    head = ["group", "seeds", "policy steps", "events in training"]
    lines = [head + [label for _, label, _ in MEASURES] + ["non-finite", "steps/s"]]
    for group in groups:
        steps = [int(run.rows["steps"].max() or 0) for run in group.runs]  # pyright: ignore
        cells = [group.name, str(len(group.runs)), f"{max(steps):,}"]
        cells.append(f"{sum(_events(run.rows) for run in group.runs):,.0f}")
        for name, _, factor in MEASURES:
            found = [r.evaluation[name] for r in group.runs if name in r.evaluation]
            cells.append(_mean(factor * np.array(found)) if found else "")
        rows = group.rows
        cells.append(str(rows["nonfinite_envs"].sum()))
        cells.append(f"{rows['time/steps_per_s'].median():,.0f}")
        lines.append(cells)
    return lines


def _events(rows: pl.DataFrame) -> float:
    """Safety events of a whole training run."""
    steps = rows["steps"].diff().fill_null(rows["steps"][0]).to_numpy() / 1e3
    names = [f"per_1000_steps/{name}" for name in EVENTS]
    return sum(float(rows[n].to_numpy() @ steps) for n in names if n in rows.columns)


def _mean(values: np.ndarray) -> str:
    text = _number(values.mean())
    if len(values) > 1:
        low, high = bootstrap_mean(values)
        text += f" [{_number(low)}, {_number(high)}]"
    return text


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


def _text(value: Any) -> str:
    return " ".join(map(str, value)) or "-" if isinstance(value, tuple) else str(value)


def _picture(figure: Figure, words: str) -> str:
    """A figure as part of the page."""
    data = io.BytesIO()
    figure.savefig(data, format="svg")
    code = base64.b64encode(data.getvalue()).decode()
    return f'<img alt="{words}" src="data:image/svg+xml;base64,{code}">'


def _html_table(lines: Sequence[Sequence[str]]) -> str:
    head, *body = ([html.escape(cell) for cell in line] for line in lines)
    rows = "".join(f"<tr><td>{'</td><td>'.join(line)}</td></tr>" for line in body)
    return f"<table><tr><th>{'</th><th>'.join(head)}</th></tr>{rows}</table>"


def page(groups: Sequence[Group]) -> str:
    """The whole page."""
    moving, flat = split_curves(groups)
    configs = [group.runs[0].config for group in groups]
    differing = [
        ["option", *(group.name for group in groups)],
        *([name, *map(_text, each)] for name, each in differences(configs).items()),
    ]
    sources = [["run", "seed", "group", "software", "device", "started"]]
    for group in groups:
        for run in group.runs:
            sources.append([str(run.folder), str(run.seed), group.name, *_origin(run)])
    parts = [
        "<h1>Comparison of runs</h1>",
        f"<p>{time.strftime('%Y-%m-%d %H:%M')}. Curves are interquartile means over "
        "the seeds with 95 % bootstrap intervals; brackets are 95 % intervals too.</p>",
        "<h2>Results</h2>",
        _html_table(table(groups)),
        "<p>Events in training are collisions, self-collisions and joint-limit events "
        "of all seeds. The measures are those of the evaluation after training.</p>",
        "<h2>Safety in the evaluation</h2>",
        _picture(safety(groups), "episodes with a safety event"),
        "<p>Exact intervals (Clopper and Pearson); no event in <i>n</i> episodes "
        "leaves a share of up to about 3 / <i>n</i>.</p>",
        "<h2>Learning</h2>",
        _picture(learning_curves(groups, moving), "learning curves"),
        f"<p>The same all the time in all runs: {', '.join(flat) or 'nothing'}.</p>",
        "<h2>What differs</h2>",
        _html_table(differing) if len(differing) > 1 else "<p>The seed alone.</p>",
        "<h2>Runs</h2>",
        _html_table(sources),
    ]
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        f"<title>Comparison of runs</title><style>{STYLE}</style>"
        f"<body>{''.join(parts)}</body></html>\n"
    )


def _origin(run: Run) -> list[str]:
    """Software, device and time of a run's last start."""
    path = run.folder / run_folder.VERSIONS
    said = json.loads(path.read_text())[-1] if path.exists() else {}
    software = f"{said.get('git', '?')}, jax {said.get('jax', '?')}"
    return [software, said.get("device", "?"), said.get("started", "?")]


def main(args: Sequence[str] | None = None) -> int:
    """Read the runs, write the page; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="run folders")
    parser.add_argument("--out", type=Path, default=Path("page.html"))
    options = parser.parse_args(args)
    try:
        groups = grouped(run for folder in options.runs for run in read_run(folder))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(page(groups))
    print(
        f"{len(groups)} groups, {sum(len(g.runs) for g in groups)} runs: {options.out}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
