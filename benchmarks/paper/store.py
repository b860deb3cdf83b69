"""The store: parquet files, each a finished part with what it was made from and how."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import polars as pl

from benchmarks.paper.cells import Cell
from rmp_mjx.files import replacing

KEY = "rmp_mjx"
"""Key of the provenance in a parquet file's metadata."""
TRAINING, EPISODES, EVENTS = "training", "episodes", "events"
"""Kinds of parts: curves by iteration; deployed episodes; what events were."""


@dataclass(frozen=True)
class Store:
    """All parts of one experiment; they are also one data set a kind."""

    folder: Path
    """Its folder."""

    def path(self, kind: str, cell: Cell, column: str | None = None) -> Path:
        """Where a part is."""
        name = cell.file + (f"-{column}" if column else "")
        return self.folder / kind / f"{name}.parquet"

    def write(
        self,
        rows: pl.DataFrame,
        about: dict[str, Any],
        kind: str,
        cell: Cell,
        column: str | None = None,
    ) -> None:
        """Write a part in one move: a killed process leaves all of it or nothing.

        Args:
            rows: Its rows; columns that say where they belong are added.
            about: Provenance, JSON-ready; `definition` is what `holds` compares.
            kind: Kind of part.
            cell: Its cell.
            column: Its deployment, where it has one.
        """
        place: dict[str, Any] = {
            "task": cell.task,
            "variant": cell.variant,
            "seed": cell.seed,
        }
        place |= {"column": column} if column else {}
        about = {"kind": kind, **place, **about, "digest": digest(rows)}
        keys = [pl.lit(value).alias(name) for name, value in place.items()]
        path = self.path(kind, cell, column)
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            rows.select(*keys, pl.exclude(list(place))).write_parquet(
                temporary, metadata={KEY: json.dumps(about)}
            )

    def about(
        self, kind: str, cell: Cell, column: str | None = None
    ) -> dict[str, Any] | None:
        """Provenance of a part; None where there is none that can be read."""
        return _about(self.path(kind, cell, column))

    def holds(
        self,
        definition: dict[str, Any],
        kind: str,
        cell: Cell,
        column: str | None = None,
    ) -> bool:
        """Whether a sound part with this definition is there."""
        about = self.about(kind, cell, column)
        return about is not None and about["definition"] == json.loads(
            json.dumps(definition)
        )

    @cached_property
    def training(self) -> pl.DataFrame:
        """Training curves: a row for each cell and iteration."""
        return self._all(TRAINING)

    @cached_property
    def episodes(self) -> pl.DataFrame:
        """Deployed episodes: a row for each."""
        return self._all(EPISODES)

    @cached_property
    def events(self) -> pl.DataFrame:
        """Events of recorded episodes: a row for each."""
        return self._all(EVENTS)

    @property
    def provenance(self) -> list[dict[str, Any]]:
        """Provenance of every part."""
        found = (_about(p) for p in sorted(self.folder.glob("*/*.parquet")))
        return [about for about in found if about]

    def _all(self, kind: str) -> pl.DataFrame:
        paths = sorted((self.folder / kind).glob("*.parquet"))
        frames = [pl.read_parquet(path) for path in paths if _about(path)]
        return pl.concat(frames, how="diagonal_relaxed") if frames else pl.DataFrame()


def digest(rows: pl.DataFrame) -> str:
    """Fingerprint of all values but times: equal for equal bits."""
    values = rows.select(pl.exclude("^time/.*$")).write_csv()
    return hashlib.sha256(values.encode()).hexdigest()[:16]


def _about(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(pl.read_parquet_metadata(path)[KEY])
        pl.read_parquet(path)  # the footer alone may be sound
    except (OSError, KeyError, ValueError, pl.exceptions.PolarsError):
        return None
    return found if "definition" in found else None
