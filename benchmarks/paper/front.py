"""The page's first screen: the claim, one figure, one table, and what is not well."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import polars as pl

from benchmarks.paper import deployment, figures, measures, store, tables, targets
from benchmarks.paper.cells import COLUMNS, PAPER, PICTURED, TASKS, VARIANTS, Preset
from benchmarks.paper.page import FIGURES, Block, Heading, Picture, Table, Text
from benchmarks.paper.store import Store
from benchmarks.paper.targets import Target

TITLE = "The paper's experiments, measured"
FIGURE = "pareto.png"
HEADLINE = (*PAPER, "vices_cbf")
"""Variants of the first table."""


def blocks(
    place: Store,
    preset: Preset,
    folder: Path,
    found: Sequence[Target],
    events: pl.DataFrame,
) -> list[Block]:
    """The first screen.

    Args:
        place: What was measured.
        preset: The experiment.
        folder: The page's folder.
        found: Every target.
        events: Recorded events of the best seeds.
    """
    figures.pareto(place, folder / FIGURES / FIGURE)
    return [
        Heading(TITLE, 1),
        Text(claim(place)),
        Picture(
            Path(FIGURES, FIGURE),
            "Success against episodes ended by an event, best seeds, with 95 % "
            "intervals. Up and right is better.",
        ),
        headline(place, PICTURED),
        Text(_made_from(place, preset)),
        *_not_well(place, found, events),
    ]


def claim(place: Store) -> str:
    """What came out, in two sentences."""
    steps = int(place.training["steps"].max())  # pyright: ignore
    events = {v: sum(_events(place, task, v) for task in TASKS) for v in PAPER}
    text = (
        f"In training, runs of {steps:,} policy steps, RMP-VICES had "
        f"{events[targets.OURS]:,} events and VICES {events[targets.BASE]:,}."
    )
    ended = _range(place, measures.ended)
    if ended is None:
        return text
    solved = _range(place, lambda rows: measures.rate(rows, "success"))
    return (
        f"{text} Deployed among {COLUMNS[PICTURED].label}, which no policy had met, "
        f"an event ended {ended}; {solved} succeeded."
    )


def headline(place: Store, column: str) -> Table:
    """The paper's variants, and the filter: events in training, best seeds deployed."""
    lines = []
    for task, title in TASKS.items():
        for variant in HEADLINE:
            trained = measures.of(place.training, task=task, variant=variant)
            rows = targets.best(place, task, variant, column)
            if trained.is_empty() or rows is None:
                continue
            every = measures.of(
                place.episodes, task=task, variant=variant, column=column
            )
            shares = (measures.rate(rows, "success"), measures.ended(rows))
            cells = (f"{r.percent:.1f} {tables.interval(r.interval)}" for r in shares)
            count = len(measures.seeds(trained))
            per_run = tables.number(measures.events(trained) / count)
            pooled = f"{measures.ended(every).percent:.1f}"
            label = VARIANTS[variant].label
            lines.append((title, label, str(count), per_run, *cells, pooled))
    header = (
        "task",
        "controller",
        "seeds",
        "events in a training",
        "deployed: success [%]",
        "ended by an event [%]",
        "the same, all seeds",
    )
    return Table(header, lines)


def _events(place: Store, task: str, variant: str) -> int:
    """Events of all trainings of a task and variant, in the seeds that both have."""
    rows = measures.of(place.training, task=task)
    both = [set(measures.seeds(measures.of(rows, variant=v))) for v in PAPER]
    rows = measures.of(rows, variant=variant)
    rows = rows.filter(pl.col("seed").is_in(sorted(both[0] & both[1])))
    return round(measures.events(rows))


def _range(
    place: Store, measure: Callable[[pl.DataFrame], measures.Rate]
) -> str | None:
    """Least and greatest share over the tasks, of ours and of VICES."""
    said = []
    for variant in (targets.OURS, targets.BASE):
        found = [targets.best(place, task, variant, PICTURED) for task in TASKS]
        shares = [measure(rows).percent for rows in found if rows is not None]
        if not shares:
            return None
        said.append(f"{min(shares):.1f} to {max(shares):.1f} %")
    return f"{said[0]} of the episodes of RMP-VICES and {said[1]} of VICES'"


def _made_from(place: Store, preset: Preset) -> str:
    trained = [a for a in place.provenance if a["kind"] == store.TRAINING]
    wanted = preset.cells()
    done = {(a["task"], a["variant"], a["seed"]) for a in trained}
    missing = [c for c in wanted if (c.task, c.variant, c.seed) not in done]
    text = (
        f"`python -m benchmarks.paper --preset {preset.name}` made this page from "
        f"{len(trained)} training runs and {len(place.episodes):,} episodes of "
        f"deployment. The paper's two controllers need {len(wanted)} runs; "
        f"{len(missing)} of them are not trained yet."
    )
    if preset.name == "smoke":
        text += " This is a smoke test: it shows that everything runs, nothing more."
    return text


def _not_well(
    place: Store, found: Sequence[Target], events: pl.DataFrame
) -> list[Block]:
    """What is not met, does not reproduce, or still fails."""
    open_ones = tables.of_targets([each for each in found if not each.met])
    reproduced = tables.reproduction(place, PICTURED)
    other = [row[:-1] for row in reproduced.rows if row[-1] != "yes"]
    blocks: list[Block] = [Heading("What is not met, not found again, or still fails")]
    blocks.append(Text(f"{verdicts(found)} Those that are not met or undecided:"))
    blocks.append(open_ones if open_ones.rows else Text("None."))
    if other:
        blocks.append(Text("What the paper found and this page does not:"))
        blocks.append(Table(reproduced.header[:-1], other))
    own = measures.of(events, variant=targets.OURS)
    number = f"{len(own)} {'event' if len(own) == 1 else 'events'}"
    blocks.append(
        Text(
            f"In the first {deployment.RECORDED} episodes of its best seeds with "
            f"{COLUMNS[PICTURED].label}, RMP-VICES had {number}."
        )
    )
    if not own.is_empty():
        blocks.append(tables.events(own))
    return blocks


def verdicts(found: Sequence[Target]) -> str:
    """How many targets are met, in one sentence."""
    words = [target.verdict for target in found]
    met, failed, undecided = map(words.count, ("met", "NOT MET", "undecided"))
    return (
        f"Of {len(found)} targets {met} are met, {failed} are not, and {undecided} "
        "are undecided."
    )
