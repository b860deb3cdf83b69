"""The command: read the runs, write the page."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from rmp_mjx.fields import arguments
from rmp_mjx.files import write_text
from rmp_mjx.report.page import page
from rmp_mjx.report.runs import grouped, read_run


def main(args: Sequence[str] | None = None) -> int:
    """Read the runs, write the page; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m rmp_mjx.report", description="Compare runs on one page."
    )
    parser.add_argument("runs", type=Path, nargs="+", help="run folders")
    parser.add_argument(
        "--out", type=Path, default=Path("page.html"), help="the page to write"
    )
    try:
        options = parser.parse_args(arguments(args))
        groups = grouped(run for folder in options.runs for run in read_run(folder))
        text = page(groups)
        options.out.parent.mkdir(parents=True, exist_ok=True)
        write_text(options.out, text)
    except (ValueError, OSError) as error:
        _say(Console(stderr=True), f"error: {error}")
        return 2
    count = sum(len(group.runs) for group in groups)
    _say(Console(), f"{len(groups)} groups, {count} runs: {options.out}")
    return 0


def _say(console: Console, line: str) -> None:
    console.print(line, markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    sys.exit(main())
