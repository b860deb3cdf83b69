"""`python -m benchmarks.paper --preset smoke|cpu|full`: the whole paper."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from rich.console import Console

from benchmarks.paper import cells, report, training
from benchmarks.paper.cells import PRESETS, Cell
from benchmarks.paper.store import Store
from envs.flags import parse
from rmp_mjx import runtime
from rmp_mjx.fields import check
from rmp_mjx.training.config import ConfigError


@dataclasses.dataclass(frozen=True)
class Options:
    """Train and deploy what is missing of the paper's grid, then write the page."""

    preset: Literal["smoke", "cpu", "full"] = "smoke"
    """smoke: minutes, tiny runs; cpu: 1.5 M steps, five seeds; full: ten seeds."""
    folder: Path | None = None
    """The store; default: runs/paper/PRESET. What is finished there is not repeated."""
    page: Path | None = None
    """Where the page goes; default: docs/results, of smoke the store's folder page."""
    only: str | None = None
    """One cell, as TASK/VARIANT/SEED: no page, but the fingerprints of its results."""
    baselines: bool = False
    """Also train and deploy the baselines, after the paper's two controllers."""
    seconds: float | None = None
    """Stop at the next safe point after this long [s]; the same command goes on."""
    report: bool = False
    """Only write the page, from what is in the store."""
    pack: Path | None = None
    """Only write what is in the store as a few small files into this folder."""
    allow_changes: bool = False
    """Continue interrupted runs although the code has changed."""

    def __post_init__(self):
        """Check the values.

        Raises:
            ConfigError: An option has no such value.
        """
        check(self, ConfigError)


def main(args: Sequence[str] | None = None) -> int:
    """Parse, do what is missing, report; returns the exit code."""
    console = Console()
    code = 0
    try:
        options = parse(Options, args)
        preset = PRESETS[options.preset]
        place = Store(options.folder or cells.home(preset))
        own = place.folder / "page" if preset.name == "smoke" else Path("docs/results")
        if options.pack:
            _say(console, place.pack(options.pack))
            return 0
        if options.seconds is not None and not options.seconds > 0:
            raise ConfigError(f"seconds must be positive, is {options.seconds}")
        wanted = preset.cells(options.baselines)
        if options.only:
            wanted = [cells.parse(options.only)]
        if not options.report:
            runtime.configure(split_cpu=True)
            code = training.run(
                place, preset, wanted, console, options.seconds, options.allow_changes
            )
        if options.only:
            _fingerprints(Store(place.folder), wanted[0])
            return code
        page = report.write(Store(place.folder), preset, options.page or own)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return code or 2
    _say(console, [page])
    return code


def _say(console: Console, written: Sequence[Path]) -> None:
    """Name the files that were written."""
    for path in written:
        console.print(f"written: {path}", markup=False, highlight=False)


def _fingerprints(place: Store, cell: Cell) -> None:
    """Print the fingerprints of a cell's results."""
    for about in place.provenance:
        if Cell(about["task"], about["variant"], about["seed"]) == cell:
            print(f"{cell} {about['kind']} {about.get('column', '')} {about['digest']}")


if __name__ == "__main__":
    sys.exit(main())
