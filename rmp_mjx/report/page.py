"""The page: tables, figures and words in one HTML file."""

import base64
import html
import io
import time
from collections.abc import Sequence

import numpy as np
import polars as pl
from matplotlib.figure import Figure

from rmp_mjx.report import details
from rmp_mjx.report.charts import EVENTS, learning_curves, safety, split_curves
from rmp_mjx.report.runs import Group, Run, differences, text
from rmp_mjx.training.runs import run_folder
from rmp_mjx.training.stats import bootstrap_mean

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


def page(groups: Sequence[Group]) -> str:
    """The whole page."""
    moving, flat = split_curves(groups)
    same = ", ".join(map(html.escape, flat)) or "nothing"
    parts = [
        "<h1>Comparison of runs</h1>",
        f"<p>{time.strftime('%Y-%m-%d %H:%M')}. Curves are interquartile means over "
        "the seeds with 95 % bootstrap intervals. Brackets are 95 % intervals.</p>",
        "<h2>Results</h2>",
        _html_table(table(groups)),
        "<p>Events in training are collisions, self-collisions and joint-limit events "
        "of all seeds. The measures are those of the evaluation after training.</p>",
        "<h2>Safety in the evaluation</h2>",
        _picture(safety(groups), "episodes with a safety event"),
        "<p>Intervals are exact (Clopper and Pearson). With no event in <i>n</i> "
        "episodes, a share of up to about 3 / <i>n</i> remains possible.</p>",
        "<h2>Learning</h2>",
        _picture(learning_curves(groups, moving), "learning curves"),
        f"<p>The same throughout all runs: {same}.</p>",
        "<h2>What differs</h2>",
        _differing(groups),
        "<h2>Runs</h2>",
        _html_table(_sources(groups)),
        *(_details(run) for group in groups for run in group.runs),
    ]
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        f"<title>Comparison of runs</title><style>{STYLE}</style>"
        f"<body>{''.join(parts)}</body></html>\n"
    )


def table(groups: Sequence[Group]) -> list[list[str]]:
    """Heading and a line for each group: means over the seeds with 95 % intervals."""
    head = ["group", "seeds", "policy steps", "events in training"]
    lines = [head + [label for _, label, _ in MEASURES] + ["non-finite", "steps/s"]]
    for group in groups:
        steps = max(int(run.rows["steps"].to_numpy().max()) for run in group.runs)
        cells = [group.name, str(len(group.runs)), f"{steps:,}"]
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
    shown = _number(values.mean())
    if len(values) > 1:
        low, high = bootstrap_mean(values)
        shown += f" [{_number(low)}, {_number(high)}]"
    return shown


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


def _differing(groups: Sequence[Group]) -> str:
    """The options in which the groups differ, a column each."""
    found = differences([group.runs[0].config for group in groups])
    if not found:
        return "<p>The seed only.</p>"
    head = ["option", *(group.name for group in groups)]
    return _html_table([head, *([n, *map(text, each)] for n, each in found.items())])


def _sources(groups: Sequence[Group]) -> list[list[str]]:
    """Where each run is, and what it ran on."""
    lines = [["run", "seed", "group", "software", "device", "started"]]
    for group in groups:
        for run in group.runs:
            lines.append([str(run.folder), str(run.seed), group.name, *_origin(run)])
    return lines


def _origin(run: Run) -> list[str]:
    """Software, device and time of a run's last start."""
    last = run_folder.last_start(run.folder)
    software = f"{last.get('git', '?')}, jax {last.get('jax', '?')}"
    return [software, last.get("device", "?"), last.get("started", "?")]


def _details(run: Run) -> str:
    """Pictures and worst episodes of a run; options and software are folded away."""
    name = html.escape(f"{run.folder}, seed {run.seed}")
    parts = [f"<h2>{name}</h2>"]
    for words, code in details.pictures(run):
        parts.append(f'<img alt="{words}" src="data:image/png;base64,{code}">')
    worst = details.worst(run)
    if worst:
        parts.append(
            "<h3>Worst episodes of the evaluation</h3>"
            f"{_html_table(worst)}<p><code>python -m rmp_mjx.viewer --episode FILE"
            "</code> opens one at the moment it happened.</p>"
        )
    for title, lines in (
        ("Options", details.options(run)),
        ("Software", details.software(run)),
    ):
        table = _html_table(lines)
        parts.append(f"<details><summary>{title}</summary>{table}</details>")
    return "".join(parts)


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
