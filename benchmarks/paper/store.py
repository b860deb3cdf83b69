"""The store: what was measured, as parquet files with what it was made from and how.

While the experiment runs, every finished part is a file of its own: KIND/PART.parquet.
`pack` merges them into one file a kind, with the columns that the page reads, and
parts.parquet, which says of each part how it was made. A store may hold both: a part's
own file comes before what is packed. A cell's policy is policies/CELL.safetensors, and
all of them are packed as policies.safetensors.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import polars as pl
import polars.selectors as cs

from benchmarks.paper.cells import PICTURED, Cell
from rmp_mjx.files import replacing
from rmp_mjx.training.policy import SUFFIX, load_policy, names, save_folder

KEY = "rmp_mjx"
"""Key of the provenance in a parquet file's metadata."""
TRAINING, EPISODES, EVENTS = "training", "episodes", "events"
"""Kinds of parts: curves by iteration; deployed episodes; what events were."""
PLACE = ("task", "variant", "seed", "column")
"""Columns that say which part a row belongs to; training has no `column`."""
PARTS, POLICIES = "parts.parquet", "policies"
"""The provenance of packed parts, and the folder of the policies."""
FURTHER = (
    "length",
    "arm_collision",
    "obstacle_collision",
    "contact_force_peak",
    "contact_impulse",
    "clearance",
    "joint_jerk",
    "torque_saturation",
    "unplaced_obstacles",
    "lost",
)
"""Columns of episodes that are packed for the deployment `PICTURED` alone."""
PACKED = {
    TRAINING: (
        *PLACE[:3],
        "steps",
        "time/steps_per_s",
        "episode/finished",
        "episode/return",
        "episode/success",
        "episode/length",
        "episode/collision",
        "episode/self_collision",
        "episode/joint_limit",
        "episode/contact_force_peak",
        "episode/via_points",
        "episode/door_angle",
        "episode/goal_distance",
        "per_1000_steps/collision",
        "per_1000_steps/self_collision",
        "per_1000_steps/joint_limit",
    ),
    EPISODES: (
        *PLACE,
        "return",
        "success",
        "collision",
        "self_collision",
        "joint_limit",
        *FURTHER,
    ),
    EVENTS: None,
}
"""Columns that are packed, if a kind has them; None: all."""
LEVEL = 22
"""Compression of packed files: zstd's strongest."""


@dataclass(frozen=True)
class Store:
    """All parts of one experiment; they are also one data set a kind."""

    folder: Path
    """Its folder."""

    def path(self, kind: str, cell: Cell, column: str | None = None) -> Path:
        """Where a part's own file is."""
        return self.folder / kind / f"{_name(cell, column)}.parquet"

    def policy(self, cell: Cell) -> Path:
        """Where a cell's trained policy is; `load_policy` finds packed ones too."""
        return self.folder / POLICIES / f"{cell.file}{SUFFIX}"

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
        place = _place(cell, column)
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
        own = _read(self.path(kind, cell, column))
        packed = self._packed_parts.get((kind, _name(cell, column)))
        return own[0] if own else packed

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
        """Provenance of every part, in the order of kinds and names."""
        found = dict(self._packed_parts)
        for kind in PACKED:
            for name, (about, _) in self._own_parts(kind).items():
                found[kind, name] = about
        return [found[part] for part in sorted(found)]

    def pack(self, folder: Path) -> list[Path]:
        """Write all parts, and all policies, as a few small files.

        Args:
            folder: Where they go; it may be the store's own folder.

        Returns:
            The files.
        """
        folder.mkdir(parents=True, exist_ok=True)
        abouts = self.provenance
        files = {PARTS: pl.DataFrame({"about": [json.dumps(each) for each in abouts]})}
        for kind, columns in PACKED.items():
            files[f"{kind}.parquet"] = _packed(self._all(kind), columns)
        for name, rows in files.items():
            with replacing(folder / name) as temporary:
                rows.write_parquet(
                    temporary,
                    compression_level=LEVEL,
                    statistics=False,
                    row_group_size=max(1, len(rows)),
                )
        own = self.folder / POLICIES
        found = {name: load_policy(own / f"{name}{SUFFIX}") for name in names(own)}
        packed = [save_folder(folder / POLICIES, found)] if found else []
        return [*(folder / name for name in files), *packed]

    def _all(self, kind: str) -> pl.DataFrame:
        """All rows of a kind, part by part."""
        own = {name: rows for name, (_, rows) in self._own_parts(kind).items()}
        parts = self._packed_rows(kind) | own
        frames = [parts[name] for name in sorted(parts)]
        return pl.concat(frames, how="diagonal_relaxed") if frames else pl.DataFrame()

    def _own_parts(self, kind: str) -> dict[str, tuple[dict[str, Any], pl.DataFrame]]:
        """Parts with a file of their own, by name."""
        paths = (self.folder / kind).glob("*.parquet")
        return {path.stem: found for path in paths if (found := _read(path))}

    @cached_property
    def _packed_parts(self) -> dict[tuple[str, str], dict[str, Any]]:
        """Provenance of packed parts by kind and name."""
        path = self.folder / PARTS
        if not path.exists():
            return {}
        abouts = map(json.loads, pl.read_parquet(path)["about"])
        return {(each["kind"], _name_of(each)): each for each in abouts}

    def _packed_rows(self, kind: str) -> dict[str, pl.DataFrame]:
        """Rows of packed parts by name."""
        path = self.folder / f"{kind}.parquet"
        if not path.exists():
            return {}
        rows = pl.read_parquet(path)
        keys = [name for name in PLACE if name in rows.columns]
        parts = rows.partition_by(keys, maintain_order=True)
        return {_name_of(part.row(0, named=True)): part for part in parts}


def _packed(rows: pl.DataFrame, columns: Sequence[str] | None) -> pl.DataFrame:
    """The columns that are packed, and numbers with 32 bits."""
    kept = [name for name in columns or rows.columns if name in rows.columns]
    rows = rows.select(kept).with_columns(cs.float().cast(pl.Float32))
    if "column" not in kept:
        return rows
    pictured = pl.when(pl.col("column") == PICTURED)
    further = [name for name in FURTHER if name in kept]
    return rows.with_columns(pictured.then(name).alias(name) for name in further)


def _name(cell: Cell, column: str | None) -> str:
    """The name of a part."""
    return f"{cell.file}-{column}" if column else cell.file


def _name_of(values: dict[str, Any]) -> str:
    """The name of the part that a row or a provenance belongs to."""
    cell = Cell(values["task"], values["variant"], values["seed"])
    return _name(cell, values.get("column"))


def _place(cell: Cell, column: str | None) -> dict[str, Any]:
    """What says where a part's rows belong."""
    place = {"task": cell.task, "variant": cell.variant, "seed": cell.seed}
    return {**place, "column": column} if column else place


def digest(rows: pl.DataFrame) -> str:
    """Fingerprint of all values but times: equal for equal bits."""
    values = rows.select(pl.exclude("^time/.*$")).write_csv()
    return hashlib.sha256(values.encode()).hexdigest()[:16]


def _read(path: Path) -> tuple[dict[str, Any], pl.DataFrame] | None:
    """Provenance and rows of a part's own file; None where it is not sound."""
    try:
        found = json.loads(pl.read_parquet_metadata(path)[KEY])
        rows = pl.read_parquet(path)  # the footer alone may be sound
    except (OSError, KeyError, ValueError, pl.exceptions.PolarsError):
        return None
    return (found, rows) if "definition" in found else None
