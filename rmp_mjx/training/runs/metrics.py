"""One iteration's statistics as a flat row of named numbers, for each seed."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
import polars as pl

from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.learning.rollout import RolloutStats
from rmp_mjx.training.learning.seeds import of_seed
from rmp_mjx.training.stats import bootstrap_curve, interquartile_mean

Row = dict[str, float | int | None]
"""Column names `group/name`; None where no episode finished."""
SEED = "seed"
"""Column that tells the rows of several seeds apart."""


def make_row(
    iteration: int,
    steps: int,
    steps_per_iteration: int,
    seconds: float,
    stats: RolloutStats,
    learning: dict[str, Any],
) -> Row:
    """Turn an iteration's device values into a row.

    Args:
        iteration: Finished iterations.
        steps: Policy steps since the start of training.
        steps_per_iteration: Policy steps that `stats` covers.
        seconds: Wall time of the iteration [s].
        stats: Sums over its steps and finished episodes.
        learning: Metrics of the learner.

    Returns:
        The row: `episode/x` are means over the episodes that finished,
        `per_1000_steps/x` the events per thousand policy steps.
    """
    stats, learning = jax.device_get((stats, learning))
    episodes = int(stats.episodes)
    row: Row = {
        "iteration": iteration,
        "steps": steps,
        "time/iteration_s": seconds,
        "time/steps_per_s": steps_per_iteration / seconds,
        "episode/finished": episodes,
    }
    for name, total in stats.episode_sums.items():
        row[f"episode/{name}"] = float(total) / episodes if episodes else None
    for name, total in stats.step_sums.items():
        row[f"per_1000_steps/{name}"] = 1000.0 * float(total) / steps_per_iteration
    row["nonfinite_envs"] = int(stats.nonfinite)
    for name, value in sorted(learning.items()):
        row[f"learning/{name}"] = float(value)
    return row


def make_rows(
    config: PPOConfig,
    iteration: int,
    seconds: float,
    stats: RolloutStats,
    learning: dict[str, Any],
) -> list[Row]:
    """The row of an iteration; with several seeds, one each, with the column `SEED`."""
    stats, learning = jax.device_get((stats, learning))
    size = config.steps_per_iteration
    rows = [
        make_row(
            iteration,
            iteration * size,
            size,
            seconds,
            *of_seed((stats, learning), k, config),
        )
        for k in range(config.num_seeds)
    ]
    if config.num_seeds == 1:
        return rows
    return [{SEED: config.seed + k, **row} for k, row in enumerate(rows)]


def of_all_seeds(rows: Sequence[Row]) -> Row:
    """An iteration of several seeds as one row.

    Values are interquartile means over the seeds in which an episode finished; speeds
    and counts add up. `steps` stays that of one agent.
    """
    first = rows[0]
    together: Row = {name: first[name] for name in ("iteration", "steps")}
    for name in first.keys() - {*together, SEED}:
        values = np.array([x for row in rows if (x := row[name]) is not None])
        if name in ("time/steps_per_s", "episode/finished", "nonfinite_envs"):
            together[name] = values.sum().item()
        else:
            middle = interquartile_mean(values) if values.size else None
            together[name] = None if middle is None else float(middle)
    return {name: together[name] for name in first if name != SEED}


def over_seeds(rows: pl.DataFrame, names: Sequence[str]) -> pl.DataFrame:
    """Curves over the seeds: the interquartile mean and its 95 % bootstrap interval.

    A seed in which no episode finished keeps its last value; iterations before every
    seed has one are left out of that column.

    Args:
        rows: Rows of a run, one a seed and iteration.
        names: Columns.

    Returns:
        `iteration`, `steps` and for each column NAME, NAME_low and NAME_high.
    """
    curves = rows.select("iteration", "steps").unique(maintain_order=True)
    for name in names:
        table = rows.pivot(on=SEED, index="iteration", values=name).sort("iteration")
        table = table.select("iteration", pl.exclude("iteration").forward_fill())
        table = table.drop_nulls()
        values = table.drop("iteration").to_numpy().T
        if not values.size:
            continue
        low, high = bootstrap_curve(values)
        middle = interquartile_mean(values)
        found = {name: middle, f"{name}_low": low, f"{name}_high": high}
        columns = [pl.Series(key, np.asarray(value)) for key, value in found.items()]
        curves = curves.join(
            table.select("iteration", *columns), on="iteration", how="left"
        )
    return curves
