"""What one run says about itself: pictures, worst episodes, options, software."""

import base64
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rmp_mjx.files import read_json
from rmp_mjx.report.runs import Run, text
from rmp_mjx.training.runs import run_folder

PICTURES = {
    run_folder.CLEARANCES: "least clearance of the evaluation's episodes",
    run_folder.FORCES: "contact forces of the evaluation's episodes",
    run_folder.STORYBOARD: "an episode of the evaluation",
}
"""Pictures of a run's folder by name, and what they show."""


def pictures(run: Run) -> Iterator[tuple[str, str]]:
    """What each recorded picture shows, and the picture as base64 of a PNG."""
    place = run_folder.seed_folder(run.config, run.folder, run.seed)
    for name, words in PICTURES.items():
        found = [p for p in (place / name, run.folder / name) if p.is_file()]
        if found:
            yield words, _encoded(found[0])


def _encoded(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode()


def options(run: Run) -> list[list[str]]:
    """Heading and a line for each option of a run."""
    return [["option", "value"], *_flat(run.config.record())]


def _flat(record: dict[str, Any], above: str = "") -> Iterator[list[str]]:
    for name, value in record.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{above}{name}.")
        else:
            yield [f"{above}{name}", text(value)]


def software(run: Run) -> Sequence[Sequence[str]]:
    """Heading and a line for each version at a run's last start."""
    found = run_folder.last_start(run.folder)
    return [["software", "version"], *([k, text(v)] for k, v in found.items())]


def worst(run: Run) -> list[list[str]]:
    """Heading and a line for each bad episode of a run's evaluation; empty without any.

    Raises:
        ValueError: Their list is damaged.
    """
    place = run_folder.seed_folder(run.config, run.folder, run.seed)
    path = place / run_folder.WORST_INDEX
    if not path.is_file():
        return []
    lines = [["episode", "least clearance [mm]", "return", "what happened", "file"]]
    try:
        for case in read_json(path)["kept"]:
            happened = ", ".join(f"{n} {t:.2f} s" for n, t in case["moments"].items())
            numbers = f"{1e3 * case['clearance']:.1f}", f"{case['return']:.1f}"
            file = str(path.parent / case["file"])
            lines.append([str(case["episode"]), *numbers, happened, file])
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is damaged: {error!r}") from error
    return lines
