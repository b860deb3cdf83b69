"""Deploy a trained cell in a column: every episode's values into the store."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import polars as pl
from rich.console import Console

from benchmarks.common import machine
from benchmarks.paper import cells, failures, store
from benchmarks.paper.cells import COLUMNS, PICTURED, TABLE, Cell, Column, Preset
from benchmarks.paper.store import Store
from rmp_mjx import runtime
from rmp_mjx.metric import reductions
from rmp_mjx.training.config import TrainConfig
from rmp_mjx.training.evaluation import evaluate, film
from rmp_mjx.training.evaluation.recording import Recording
from rmp_mjx.training.policy import load_policy

STARTS = 2000
"""Seed of the episodes: the same in every cell, so that all meet the same worlds."""
RECORDED = 100
"""Episodes of the pictured column that are recorded."""
ALIKE = {"terminate_on_event": True}
"""Options that no training may change: every deployed episode ends with an event."""


def deployed(config: TrainConfig, column: Column) -> TrainConfig:
    """A training's configuration with the world of a column."""
    physics = column.physics or config.task.physics
    return config.replace(**column.options, **ALIKE, physics=physics)


def definition(preset: Preset, cell: Cell, column: Column) -> dict[str, Any]:
    """What a deployment depends on."""
    variant = cells.VARIANTS[cell.variant]
    options = preset.options, variant.options, column.options, ALIKE
    return {
        "training": cells.definition(preset, cell),
        "env_options": cells.texts(*options),
        "physics": deployed(preset.config(cell), column).task.physics,
        "episodes": episodes(preset, column),
        "starts": STARTS,
    }


def episodes(preset: Preset, column: Column) -> int:
    """Episodes of a column."""
    return preset.episodes if column.name in TABLE else preset.other_episodes


def is_deployed(place: Store, preset: Preset, cell: Cell, name: str) -> bool:
    """Whether a deployment is in the store."""
    wanted = definition(preset, cell, COLUMNS[name])
    found = place.holds(wanted, store.EPISODES, cell, name)
    if name == PICTURED:
        found &= place.holds(wanted, store.EVENTS, cell, name)
    return found


def deploy(
    place: Store, preset: Preset, cell: Cell, name: str, console: Console
) -> None:
    """Run a trained cell's mean policy in a column.

    Raises:
        PolicyError: The policy's file is missing or damaged.
    """
    column, config = COLUMNS[name], preset.config(cell)
    count = episodes(preset, column)
    filmed = min(RECORDED, count) if name == PICTURED else 0
    env, record = _recorder(deployed(config, column), count, filmed)
    policy = load_policy(place.policy(cell))
    agent = policy.agent(env.observation_size, env.action_size, True)
    began = time.monotonic()
    results, tape = record(agent, jax.random.key(STARTS))
    about = {
        "definition": definition(preset, cell, column),
        "seconds": time.monotonic() - began,
        "training_iterations": policy.about["iterations"],
        "dt": env.dt,
        "reductions": reductions(env.metrics),
        "date": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "machine": machine(),
    }
    if filmed:
        events = failures.describe(env, results, tape)
        save(env, tape, events, folder(place, cell), console)
        place.write(
            pl.DataFrame(events, failures.SCHEMA), about, store.EVENTS, cell, name
        )
    values = {key: np.asarray(each, np.float32) for key, each in results.items()}
    place.write(pl.DataFrame(values), about, store.EPISODES, cell, name)


@functools.lru_cache(maxsize=64)
def _world(config: TrainConfig, count: int, filmed: int):
    env = cells.load(config)
    return env, evaluate.recorder(env, count, filmed)


def _recorder(config: TrainConfig, count: int, filmed: int):
    """The task of a configuration and its recorder, compiled once for all seeds."""
    return _world(config.replace(seed=0), count, filmed)


INSTANCE, STORYBOARD = "instance.png", "storyboard.png"
FAILURES = 3
"""Ends of failed episodes that are drawn."""


def folder(place: Store, cell: Cell) -> Path:
    """Where a cell's pictures are."""
    return place.folder / "pictures" / cell.file


def failure(number: int) -> str:
    """File of the end of a failed episode."""
    return f"event{number}.png"


def save(
    env: Any,
    tape: Recording,
    events: Sequence[Mapping[str, Any]],
    place: Path,
    console: Console,
) -> None:
    """Draw the first episode and the ends of the first that failed, or say why not.

    Args:
        env: The environment.
        tape: Recorded episodes.
        events: Rows of `failures.describe`.
        place: Where the files go.
        console: Terminal.
    """
    if runtime.choose_gl() is None:
        console.print("no pictures: no headless rendering here")
        return
    try:
        import mediapy

        from envs.render import render  # loads graphics libraries

        draw = partial(render, env)
        place.mkdir(parents=True, exist_ok=True)
        (instance,) = draw([tape.state(0, 0)], film.LARGE, True)
        mediapy.write_image(place / INSTANCE, instance)
        mediapy.write_image(place / STORYBOARD, film.storyboard(draw, tape))
        ends = [tape.state(row["episode"], row["step"]) for row in events[:FAILURES]]
        stills = draw(ends, film.SMALL, True) if ends else []
        for number, still in enumerate(stills):
            mediapy.write_image(place / failure(number), still)
    except Exception as error:  # graphics stacks fail in many ways; numbers are safe
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        console.print(f"no pictures: {reason}", markup=False, highlight=False)
