"""Demonstrations as a dataset in LeRobot's layout, version 2.1, without its package.

`python -m rmp_mjx.training.lerobot DEMOS.parquet FOLDER`. A parquet file for each
episode, and lines of JSON for episodes, tasks and statistics. LeRobot's own script
`convert_dataset_v21_to_v30` makes version 3.0 of it, whose tables need pandas.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from rmp_mjx.files import write_text
from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.demonstrations import Demonstrations, read

VERSION = "v2.1"
CHUNK = 1000
"""Episodes in a folder."""
PLACE = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
"""Where an episode's file is."""


def frames(demos: Demonstrations) -> pl.DataFrame:
    """A row for each policy step; `next.` marks what came after it."""
    count = len(demos.step)
    vectors = {"observation.state": demos.observation, "action": demos.action}
    flags = {"next.done": demos.done, "next.success": demos.success}
    numbers = {
        "frame_index": demos.step,
        "episode_index": np.unique(demos.episode, return_inverse=True)[1],
        "index": np.arange(count),
        "task_index": np.zeros(count),
    }
    return pl.DataFrame(
        [
            *(
                pl.Series(name, x, pl.Array(pl.Float32, x.shape[1]))
                for name, x in vectors.items()
            ),
            pl.Series("next.reward", demos.reward, pl.Float32),
            *(pl.Series(name, x, pl.Boolean) for name, x in flags.items()),
            pl.Series("timestamp", demos.step * demos.about["dt"], pl.Float32),
            *(pl.Series(n, x.astype(np.int64), pl.Int64) for n, x in numbers.items()),
        ]
    )


def features(table: pl.DataFrame, about: dict[str, Any]) -> dict[str, Any]:
    """Type, shape and names of every column."""
    entries = [
        f"{name}_{k}" if size > 1 else name
        for name, size in about["observation"]
        for k in range(size)
    ]
    names = {"observation.state": entries or None, "action": about["action"] or None}
    kinds = {pl.Int64: "int64", pl.Boolean: "bool"}
    return {
        name: {
            "dtype": kinds.get(type(kind), "float32"),
            "shape": list(kind.shape) if isinstance(kind, pl.Array) else [1],
            "names": names.get(name),
        }
        for name, kind in table.schema.items()
    }


def statistics(table: pl.DataFrame) -> dict[str, Any]:
    """Least, greatest, mean, deviation and number of every column's values."""
    found = {}
    for name in table.columns:
        x = table[name].to_numpy().reshape(len(table), -1).astype(float)
        measures = {
            "min": x.min(0),
            "max": x.max(0),
            "mean": x.mean(0),
            "std": x.std(0),
        }
        found[name] = {k: v.tolist() for k, v in measures.items()} | {"count": [len(x)]}
    return found


def export(demos: Demonstrations, folder: Path) -> None:
    """Write a dataset.

    Args:
        demos: What it is of.
        folder: Where it goes; a new folder.

    Raises:
        ConfigError: The folder exists.
    """
    if folder.exists():
        raise ConfigError(f"{folder} exists: name a new folder")
    (folder / "meta").mkdir(parents=True)
    about, table = demos.about, frames(demos)
    task = str(about["task"].get("env", "demonstrations"))
    episodes, measured = [], []
    for k, rows in enumerate(table.partition_by("episode_index", maintain_order=True)):
        path = folder / PLACE.format(episode_chunk=k // CHUNK, episode_index=k)
        path.parent.mkdir(parents=True, exist_ok=True)
        rows.write_parquet(path)
        episodes.append({"episode_index": k, "tasks": [task], "length": len(rows)})
        measured.append({"episode_index": k, "stats": statistics(rows)})
    info = {
        "codebase_version": VERSION,
        "robot_type": about["task"].get("robot"),
        "total_episodes": demos.episodes,
        "total_frames": len(table),
        "total_tasks": 1,
        "total_videos": 0,
        "total_chunks": -(-demos.episodes // CHUNK),
        "chunks_size": CHUNK,
        "fps": round(1.0 / about["dt"]),
        "splits": {"train": f"0:{demos.episodes}"},
        "data_path": PLACE,
        "video_path": None,
        "features": features(table, about),
    }
    write_text(folder / "meta/info.json", json.dumps(info, indent=4) + "\n")
    lines = {"tasks": [{"task_index": 0, "task": task}], "episodes": episodes}
    for name, records in (lines | {"episodes_stats": measured}).items():
        text = "".join(json.dumps(record) + "\n" for record in records)
        write_text(folder / f"meta/{name}.jsonl", text)


def main(args: Sequence[str] | None = None) -> int:
    """Export a file of demonstrations; returns the exit code."""
    parser = argparse.ArgumentParser(description="Demonstrations in LeRobot's layout.")
    parser.add_argument("demos", type=Path, help="file of demonstrations")
    parser.add_argument("folder", type=Path, help="new folder for the dataset")
    options = parser.parse_args(args)
    try:
        export(read(options.demos), options.folder)
    except (ConfigError, OSError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
