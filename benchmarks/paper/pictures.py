"""Pictures of a deployment: an instance, a storyboard, the ends of failed episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.paper.cells import Cell
from benchmarks.paper.store import Store
from rmp_mjx import runtime
from rmp_mjx.training.evaluation import film
from rmp_mjx.training.evaluation.recording import Recording

INSTANCE, STORYBOARD = "instance.png", "storyboard.png"
FAILURES = 3
"""Ends of failed episodes that are drawn."""


def folder(place: Store, cell: Cell) -> Path:
    """Where a cell's pictures are."""
    return place.folder / "pictures" / cell.file


def failure(number: int) -> str:
    """File of the end of a failed episode."""
    return f"event{number}.png"


def save(
    env: Any,
    tape: Recording,
    events: Sequence[Mapping[str, Any]],
    place: Path,
    console: Console,
) -> None:
    """Draw the first episode and the ends of the first that failed, or say why not.

    Args:
        env: The environment.
        tape: Recorded episodes.
        events: Rows of `failures.describe`.
        place: Where the files go.
        console: Terminal.
    """
    if runtime.choose_gl() is None:
        console.print("no pictures: no headless rendering here")
        return
    try:
        import mediapy

        from envs.render import render  # loads graphics libraries

        draw = partial(render, env)
        place.mkdir(parents=True, exist_ok=True)
        (instance,) = draw([tape.state(0, 0)], film.LARGE, True)
        mediapy.write_image(place / INSTANCE, instance)
        mediapy.write_image(place / STORYBOARD, film.storyboard(draw, tape))
        ends = [tape.state(row["episode"], row["step"]) for row in events[:FAILURES]]
        stills = draw(ends, film.SMALL, True) if ends else []
        for number, still in enumerate(stills):
            mediapy.write_image(place / failure(number), still)
    except Exception as error:  # graphics stacks fail in many ways; numbers are safe
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        console.print(f"no pictures: {reason}", markup=False, highlight=False)
