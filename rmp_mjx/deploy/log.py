"""A log of the last ticks, in memory of fixed size, and as a parquet file."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

VECTORS = ("q", "qd", "tau", "tau_ext")
"""Columns with one number for each joint."""
NUMBERS = ("time", "interval", "work", "clearance", "obstacle_age", "phase")
"""Columns with one number; times in seconds."""


class RingLog:
    """The last ticks of a loop."""

    def __init__(self, n: int, capacity: int):
        """Allocate it.

        Args:
            n: Number of joints.
            capacity: Ticks that are kept.
        """
        self.capacity, self.count = capacity, 0
        self._columns = {name: np.zeros((capacity, n)) for name in VECTORS}
        self._columns |= {name: np.zeros(capacity) for name in NUMBERS}

    def add(self, **values: Any) -> None:
        """Log one tick; the oldest one is forgotten where there is no room."""
        place = self.count % self.capacity
        for name, value in values.items():
            self._columns[name][place] = value
        self.count += 1

    def columns(self) -> dict[str, np.ndarray]:
        """The ticks that are kept, oldest first, by column."""
        first = max(self.count - self.capacity, 0)
        order = np.arange(first, self.count) % self.capacity
        return {name: column[order] for name, column in self._columns.items()}

    def write(self, path: Path) -> None:
        """Write a parquet file with one row for each tick.

        Raises:
            ImportError: polars is not installed.
        """
        check_writable()
        import polars as pl

        found = {}
        for name, column in self.columns().items():
            if column.ndim == 1:
                found[name] = column
            else:
                found |= {f"{name}{k}": column[:, k] for k in range(column.shape[1])}
        pl.DataFrame(found).write_parquet(path)


def check_writable() -> None:
    """See, before an arm moves, that a log can be written.

    Raises:
        ImportError: polars is not installed.
    """
    if importlib.util.find_spec("polars") is None:
        raise ImportError("a log needs polars: pip install polars, or give no log file")
