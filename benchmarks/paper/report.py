"""The page of results, from the store alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import polars as pl

from benchmarks.paper import cells, figures, front, measures, store, tables, targets
from benchmarks.paper.cells import (
    COLUMNS,
    PAPER,
    PICTURED,
    TABLE,
    VARIANTS,
    Preset,
)
from benchmarks.paper.page import (
    FIGURES,
    Block,
    Code,
    Heading,
    Picture,
    Table,
    Text,
    markdown,
)
from benchmarks.paper.store import Store
from benchmarks.paper.targets import Target
from rmp_mjx.files import write_text


def write(place: Store, preset: Preset, folder: Path) -> Path:
    """Draw the figures and write the page.

    Args:
        place: What was measured.
        preset: The experiment.
        folder: Where `index.md` and the figures go.

    Returns:
        The page.

    Raises:
        ValueError: The store holds no finished training.
    """
    if place.training.is_empty():
        raise ValueError(f"{place.folder} holds no finished training yet")
    (folder / FIGURES).mkdir(parents=True, exist_ok=True)
    found, events = targets.targets(place), figures.best_events(place)
    blocks = [
        *front.blocks(place, preset, folder, found, events),
        *_targets(found),
        *_reproduction(place),
        *_training(place, folder),
        *_deployment(place, folder),
        *_beyond(place, preset, folder),
        *_failures(place, folder, events),
        *_pictures(place, folder),
        *_protocol(place, preset),
    ]
    written = folder / "index.md"
    write_text(written, markdown(blocks))
    return written


def _targets(found: Sequence[Target]) -> list[Block]:
    return [
        Heading("Every target"),
        Text(
            f"{front.verdicts(found)} The 95 % interval decides: a target is met where "
            "all of the interval is on its side, not met where all of it is on the "
            "other, else undecided. An event that must not happen is one that did not, "
            f"in so many episodes that the interval ends below {targets.RARE} %. "
            "Intervals of changes in training are paired over seeds: bootstraps, for "
            "three seeds or more, and Student's t. Those of deployed returns and "
            "successes are paired over the episodes of the best seeds, which have the "
            "same starts. Intervals of shares are Clopper and Pearson's."
        ),
        tables.of_targets(found),
    ]


def _reproduction(place: Store) -> list[Block]:
    return [
        Heading("What reproduces, and what does not"),
        Text(
            "Each finding of the paper, and whether its direction is found here. The "
            "paper gives neither the distance of its spheres nor its physics settings, "
            "so its absolute numbers are not comparable. Policies are deployed with "
            f"{COLUMNS[PICTURED].label}."
        ),
        tables.reproduction(place, PICTURED),
    ]


def _training(place: Store, folder: Path) -> list[Block]:
    figures.training(place, folder / FIGURES / "training.png")
    blocks: list[Block] = [
        Heading("Training"),
        Picture(
            Path(FIGURES, "training.png"),
            "Return, collisions and joint-limit events per episode over training: mean "
            "over the seeds and its 95 % interval (Student's t).",
        ),
        Text(
            "Area under the mean curves, divided by the number of steps, and its "
            "change from VICES to RMP-VICES, computed as in the paper. It covers the "
            "steps where both have finished episodes."
        ),
        tables.training(place),
        Text(
            "Events per 1,000 policy steps over the whole training; unlike events per "
            "episode, they do not depend on the length of episodes. The last column is "
            "the speed of training, updates included."
        ),
        tables.totals(place),
    ]
    others = sorted(set(place.training["variant"].unique()) - set(PAPER))
    if others:
        figures.training(
            place, folder / FIGURES / "training_baselines.png", tuple(VARIANTS)
        )
        names = ", ".join(VARIANTS[name].label for name in others)
        blocks.append(
            Picture(
                Path(FIGURES, "training_baselines.png"),
                f"The same with the baselines: {names}.",
            )
        )
    return blocks


def _deployment(place: Store, folder: Path) -> list[Block]:
    figures.forces(place, folder / FIGURES / "forces.png", PICTURED)
    blocks: list[Block] = [
        Heading("Deployment among unseen spheres"),
        Text(
            "The best seed of each variant, which is the one with the greatest mean "
            f"return over the last {measures.LAST:.0%} of training. Policies take the "
            "mean action. All meet the same starts, goals and spheres. An event ends "
            "the episode. The paper's column shows return, collisions and joint limits "
            "of 100 episodes."
        ),
    ]
    for column in TABLE:
        table = tables.deployment(place, column)
        if table.rows:
            blocks += [Heading(COLUMNS[column].label, 3), table]
    return [
        *blocks,
        Heading("Severity of collisions", 3),
        Picture(
            Path(FIGURES, "forces.png"),
            "Greatest contact force of each episode with a contact. Training keeps "
            "only the mean over the episodes that finish in an iteration. There, each "
            "of these episodes counts with the mean over those that a contact ended. "
            "Contacts of the hand with the handle or the block are excluded.",
        ),
        Heading("Further measures", 3),
        Text(f"Best seeds among {COLUMNS[PICTURED].label}; means have 95 % intervals."),
        tables.further(place, PICTURED),
    ]


def _beyond(place: Store, preset: Preset, folder: Path) -> list[Block]:
    figures.robustness(place, folder / FIGURES / "robustness.png", preset.columns)
    return [
        Heading("Robustness"),
        Picture(
            Path(FIGURES, "robustness.png"),
            "Best seeds under conditions that training did not have.",
        ),
        Text("Success, then episodes ended by an event, both in per cent."),
        tables.robustness(place, preset.columns),
        Heading("Every seed, and tests paired by seed"),
        tables.seeds(place, PICTURED),
        Text(
            "RMP-VICES minus VICES with the same seed. The sign-flip test is exact, "
            "but with k seeds its p-value cannot be below 2 / 2^k. There is no "
            "correction for multiple tests."
        ),
        tables.paired(place, PICTURED),
    ]


def _failures(place: Store, folder: Path, events: pl.DataFrame) -> list[Block]:
    ours = measures.of(events, variant=targets.OURS)
    blocks: list[Block] = [
        Heading("What events were"),
        Text(
            "The events that ended recorded episodes. Recorded are the first 100 "
            f"episodes of the best seeds with {COLUMNS[PICTURED].label}. There were "
            f"{len(ours)} events with RMP-VICES and {len(events) - len(ours)} with the "
            "others. Each is attributed to the pair that is closest at the end of its "
            "policy step. Forces are normal forces; a joint limit has none."
        ),
    ]
    if not events.is_empty():
        blocks.append(tables.events(events))
    if figures.failures(place, folder / FIGURES / "failures.png", events):
        caption = "How episodes ended with RMP-VICES."
        blocks.append(Picture(Path(FIGURES, "failures.png"), caption))
    return blocks


def _pictures(place: Store, folder: Path) -> list[Block]:
    blocks: list[Block] = []
    if figures.instances(place, folder / FIGURES / "instances.png"):
        caption = f"Instances of the tasks, {COLUMNS[PICTURED].label}."
        blocks.append(Picture(Path(FIGURES, "instances.png"), caption))
    if figures.storyboard(place, folder / FIGURES / "storyboard.png", "door"):
        caption = "Regularly timed stills of one episode of door opening."
        blocks.append(Picture(Path(FIGURES, "storyboard.png"), caption))
    if not blocks:
        blocks.append(Text("Headless rendering was not available on this machine."))
    return [Heading("Pictures"), *blocks]


def _protocol(place: Store, preset: Preset) -> list[Block]:
    trained = [a for a in place.provenance if a["kind"] == store.TRAINING]
    histories = [a["history"] for a in trained]
    last = histories[-1][-1]
    config: dict[str, Any] = trained[-1]["definition"]
    shared, options = cells.settings(preset), cells.texts(preset.options)
    rows = [(k, str(v)) for k, v in shared.items() if k != "seed"]
    size = config["num_envs"] * config["unroll_length"]
    continued = sum(len(history) > 1 for history in histories)
    revisions = sorted({entry["git"] for history in histories for entry in history})
    started = sorted(entry["started"] for history in histories for entry in history)
    deployed = {str(a["machine"]["cpu"]) for a in place.provenance if "machine" in a}
    about = [
        ("revisions", ", ".join(revisions)),
        ("device", last["device"]),
        ("machine", f"{last['machine']}; {', '.join(sorted(deployed))}"),
        ("dates", f"{started[0]} to {started[-1]}"),
        ("runs that were stopped and continued", f"{continued} of {len(trained)}"),
        *((k, v) for k, v in last.items() if k in ("python", "jax", "mujoco", "numpy")),
    ]
    return [
        Heading("Protocol"),
        Text(
            "All variants train with the same settings, listed below. The leaf "
            "parameters of RMP-VICES were chosen before, mostly with policies that "
            "had learned nothing. For door and push, the collision leaves of the "
            "spheres were chosen with trained policies, on 400 of the close layouts "
            "below. VICES has its authors' gains. The safety filter has the control "
            "points and obstacles of the tree and a margin of 5 mm. Neither was "
            "tuned here. As in the paper, the networks have two hidden layers of 64 "
            "with tanh, the algorithm is PPO, an event ends the episode, and there "
            "are no spheres in training. Unlike in the paper, an "
            f"iteration gathers {size:,} steps from {config['num_envs']} environments, "
            "episodes of door and push last 256 policy steps instead of 1024 unless "
            "the options below say otherwise, and arm, scene and physics are this "
            "project's."
        ),
        Code(
            f"python -m benchmarks.paper --preset {preset.name}\n"
            f"python -m benchmarks.paper --preset {preset.name} "
            "--only door/rmp_vices/0 --folder runs/again"
        ),
        Text(
            "The first command makes what is missing, then this page. The second "
            "repeats one run. On the same machine, with the same versions, its "
            "fingerprint is the one below. A fingerprint is a hash of all values of "
            "the training curves except times."
        ),
        tables.runs(place),
        Table(("provenance", ""), about),
        Table(
            ("setting", "value"),
            [
                *rows,
                ("options of the tasks", " ".join(options) or "default"),
            ],
        ),
    ]
