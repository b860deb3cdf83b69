"""Learning curves of VICES from the committed results, to compare a run with."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import polars as pl

from envs.options import Options

RESULTS = Path(__file__).parents[1] / "docs/results/store/training.parquet"
"""Training rows of all the paper's runs, in a checkout of the repository."""
VARIANT = "vices"
"""The baseline among them."""
FREE = ("controller", "physics")
"""Options in which a run may differ from the baseline and still be compared."""


def rows(options: Options, results: Path = RESULTS) -> pl.DataFrame | None:
    """Training rows of VICES on a task, with the column `seed`.

    Args:
        options: Options of the task. The baseline ran with the defaults.
        results: File with the rows.

    Returns:
        The rows; None if the options are not the defaults, or nothing is known.
    """
    changes = {name: getattr(options, name) for name in FREE}
    if options != dataclasses.replace(type(options)(), **changes):
        return None
    if not results.exists():
        return None
    of_task = (pl.col("task") == options.env) & (pl.col("variant") == VARIANT)
    found = pl.scan_parquet(results).filter(of_task).collect()
    if found.is_empty():
        return None
    # All runs of the results have iterations of one size.
    return found.with_columns(iteration=pl.col("steps"))
