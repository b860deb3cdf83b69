"""One iteration's statistics as a flat row of named numbers."""

from typing import Any

import jax

from rmp_mjx.training.rollout import RolloutStats

Row = dict[str, float | int | None]
"""Column names `group/name`; None where no episode finished."""


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
    row["nonfinite_steps"] = int(stats.nonfinite)
    for name, value in sorted(learning.items()):
        row[f"learning/{name}"] = float(value)
    return row
