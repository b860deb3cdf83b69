"""Several runs that differ in task and controller, one after the other.

A grid's folder has a run folder for every cell and `grid.json`: the configurations, and
which cells have finished. A grid that was interrupted goes on where it stopped.
"""

import itertools
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from rmp_mjx.files import read_json, write_text
from rmp_mjx.training.config import (
    ConfigError,
    TrainConfig,
)
from rmp_mjx.training.runs import distributed, run_folder

from .flags import typed

GRID = "grid.json"
FAILED, INTERRUPTED = 1, 128
"""Exit codes of a run: this one, and those above the second."""


@dataclass(frozen=True)
class Grid:
    """The cells of a grid and the folder they live in."""

    folder: Path
    """Folder of the grid."""
    configs: dict[str, TrainConfig]
    """What the cells of each task share."""
    controllers: tuple[str, ...]
    """Controllers."""

    def cells(self) -> dict[str, TrainConfig]:
        """Configurations by the name of their cell, new ones or to be resumed."""
        return {
            _name(env, controller): self._cell(env, controller)
            for env, controller in itertools.product(self.configs, self.controllers)
        }

    def _cell(self, env: str, controller: str) -> TrainConfig:
        folder, config = self.folder / _name(env, controller), self.configs[env]
        can_resume = config.trainer == "ours"
        begun = can_resume and (folder / run_folder.CONFIG).exists()
        return config.replace(
            controller=controller,
            run_dir=None if begun else str(folder),
            resume=str(folder) if begun else None,
            overwrite=not begun,  # it may have been stopped before it was described
        )

    def finished(self) -> dict[str, Any]:
        """Iterations and seconds of the cells that have finished."""
        path = self.folder / GRID
        return read_json(path)["finished"] if path.exists() else {}

    def save(self, finished: dict[str, Any]) -> None:
        """Write `grid.json`."""
        self.folder.mkdir(parents=True, exist_ok=True)
        document = {
            "configs": {
                env: config.replace(run_dir=None, resume=None, overwrite=False).record()
                for env, config in self.configs.items()
            },
            "controllers": self.controllers,
            "finished": finished,
        }
        write_text(self.folder / GRID, json.dumps(document, indent=2) + "\n")


def _name(env: str, controller: str) -> str:
    """The name of a cell and of its folder."""
    return run_folder.name_of(f"{env}-{controller}")


def load_grid(folder: Path) -> tuple[dict[str, dict[str, Any]], tuple[str, ...]]:
    """What a grid was started with: records of its tasks' configurations, controllers.

    Raises:
        ConfigError: `grid.json` cannot be read.
    """
    path = folder / GRID
    try:
        saved = read_json(path)
        if "config" in saved:  # of version 0.1
            saved["configs"] = {e: saved["config"] | {"env": e} for e in saved["envs"]}
        for cell in saved.get("finished", {}).values():
            int(cell["iterations"])
        ",".join(saved["controllers"])
        return dict(saved["configs"]), tuple(saved["controllers"])
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ConfigError(f"{path} cannot be read as a grid: {error}") from error


def open_grid(configs: dict[str, TrainConfig], controllers: tuple[str, ...]) -> Grid:
    """The grid that the options name: a new one, or with `resume` the one there.

    Raises:
        ConfigError: Its folder is in use, or `resume` names no grid.
    """
    run = next(iter(configs.values())).run
    if run.resume:
        folder = Path(run.resume)
    else:
        stamp = time.strftime("%Y%m%d-%H%M%S")
        folder = Path(run.run_dir or f"runs/grid-{stamp}")
        if folder.exists() and not folder.is_dir():
            raise ConfigError(f"{folder} is no folder")
        if folder.exists() and any(folder.iterdir()):
            raise ConfigError(
                f"{folder} is not empty: --resume {folder} continues that grid"
            )
    return Grid(folder, configs, controllers)


def run(grid: Grid, train: Callable[[TrainConfig], int], console: Console) -> int:
    """Train every cell that has not finished.

    Args:
        grid: The grid.
        train: Trains one cell; returns its exit code.
        console: Terminal.

    Returns:
        0, 1 where a cell failed (the others are trained all the same), or the exit
        code of the cell during which a signal came.
    """
    finished, failed, spent = grid.finished(), [], []
    cells, again = grid.cells(), typed("train", "envs", *grid.configs)
    if distributed.is_primary():
        grid.save(finished)
    for number, (name, config) in enumerate(cells.items(), 1):
        if finished.get(name, {}).get("iterations", 0) >= config.num_iterations:
            console.print(f"cell {number}/{len(cells)}: {name} has finished")
            continue
        left = sum(other not in finished for other in cells) - len(failed)
        eta = f", eta {_duration(left * sum(spent) / len(spent))}" if spent else ""
        console.print(f"cell {number}/{len(cells)}: {name}{eta}", highlight=False)
        began = time.monotonic()
        code = train(config)
        if code > INTERRUPTED:
            console.print(
                f"continue the grid with\n  {again} --resume {grid.folder}",
                highlight=False,
            )
            return code
        if code:
            failed.append(name)
            continue
        spent.append(time.monotonic() - began)
        seconds = round(spent[-1], 1)
        finished[name] = {"iterations": config.num_iterations, "seconds": seconds}
        if distributed.is_primary():
            grid.save(finished)
    if failed:
        console.print(f"failed: {', '.join(failed)}")
    return FAILED if failed else 0


def _duration(seconds: float) -> str:
    """Hours and minutes."""
    hours, minutes = divmod(round(seconds / 60.0), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"
