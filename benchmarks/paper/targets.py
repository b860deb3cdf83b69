"""The targets that ours is held to, each with what was measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import polars as pl

from benchmarks.paper import measures
from benchmarks.paper.cells import COLUMNS, TABLE, TASKS
from benchmarks.paper.store import Store
from rmp_mjx.training.stats import Interval

EPISODES = 100
"""Episodes of each entry of the paper's deployment table; fewer decide nothing."""

TRAINING_DROP = {
    "collision": {"trajectory": None, "door": 39.8, "push": 54.6},
    "joint_limit": {"trajectory": 90.5, "door": 90.7, "push": 93.2},
}
"""Events in training: how much lower the area under RMP-VICES' curve is than under
VICES' [%]; None: not applicable."""


class Deployed(NamedTuple):
    """An entry of the deployment table."""

    mean: float
    """Mean return."""
    sd: float
    """Its standard deviation."""
    collision: int
    """Episodes of 100 that a collision ended."""
    joint_limit: int
    """Episodes of 100 that a joint limit ended."""


DEPLOYMENT = {
    "vices": {
        "trajectory": Deployed(7864.0, 11670.0, 56, 44),
        "door": Deployed(1703.0, 1948.0, 61, 36),
        "push": Deployed(1755.0, 2256.0, 93, 0),
    },
    "rmp_vices": {
        "trajectory": Deployed(6847.0, 3723.0, 25, 22),
        "door": Deployed(1051.0, 696.0, 5, 11),
        "push": Deployed(1740.0, 854.0, 19, 0),
    },
}
"""Deployed among two unseen spheres."""


DROP = -99.0
"""Wanted change of events in training against VICES [%]."""
RARE = 0.5
"""No event in so many episodes counts as none where the interval ends below [%]."""
OURS, BASE = "rmp_vices", "vices"


@dataclass(frozen=True)
class Target:
    """One target in one task."""

    claim: str
    """What is wanted."""
    task: str
    """Task."""
    measured: str
    """What was measured."""
    interval: str
    """The 95 % interval that decides."""
    met: bool | None
    """Whether all of the interval is on the wanted side, or all on the other; None:
    neither, or not measured."""

    @property
    def verdict(self) -> str:
        """One word."""
        return {True: "met", False: "NOT MET", None: "undecided"}[self.met]


def targets(place: Store) -> list[Target]:
    """Every target in every task, measured or not."""
    found: list[Target] = []
    for task in TASKS:
        rows = measures.of(place.training, task=task)
        for event, name in (
            ("collision", "collisions"),
            ("joint_limit", "joint limits"),
        ):
            claim = f"training: {name} at least {-DROP:.0f} % below VICES"
            found.append(_drop(claim, task, rows, f"episode/{event}"))
        found.append(_efficiency(task, rows))
        for column in TABLE:
            found += _deployed(place, task, column)
    return found


def at_least(interval: Interval | None, bound: float) -> bool | None:
    """Whether a value is at least a bound; None: its interval has both sides."""
    if interval is None or not np.isfinite(interval).all():
        return None
    low, high = interval
    return True if low >= bound else (False if high < bound else None)


def at_most(interval: Interval | None, bound: float) -> bool | None:
    """Whether a value is at most a bound; None: its interval has both sides."""
    return at_least(interval and (-interval[1], -interval[0]), -bound)


def never(rate: measures.Rate) -> bool | None:
    """Whether an event does not happen: no single one, in episodes enough to say so."""
    return at_most(rate.interval, RARE) if rate.hits == 0 else False


def pair(
    rows: pl.DataFrame, name: str
) -> tuple[measures.Curves, measures.Curves] | None:
    """Curves of ours and of VICES; None where one is missing."""
    both = [measures.of(rows, variant=variant) for variant in (OURS, BASE)]
    if any(part.is_empty() for part in both):
        return None
    ours, base = (measures.curves(part, name) for part in both)
    return ours, base


def change(rows: pl.DataFrame, name: str) -> tuple[float, Interval | None] | None:
    """Change of ours against VICES in the area under a training curve [%]."""
    found = pair(rows, name)
    if found is None:
        return None
    own, base = measures.areas(*found)
    return measures.percent_change(own, base), measures.change_interval(own, base)


def _drop(claim: str, task: str, rows: pl.DataFrame, name: str) -> Target:
    found = change(rows, name)
    if found is None or not np.isfinite(found[0]):
        why = "" if found is None else "no such event under VICES"
        return Target(claim, task, why, "", None)
    value, interval = found
    shown = _show(interval, " %")
    return Target(claim, task, f"{value:+.1f} %", shown, at_most(interval, DROP))


def _efficiency(task: str, rows: pl.DataFrame) -> Target:
    claim = "training: area under the return's curve at least VICES'"
    found = pair(rows, "episode/return")
    if found is None:
        return Target(claim, task, "", "", None)
    own, base = measures.areas(*found)
    if not np.isfinite([*own, *base]).all():
        return Target(claim, task, "", "", None)
    by_seed = (
        dict(zip(curves.seeds, each, strict=True))
        for curves, each in zip(found, (own, base), strict=True)
    )
    compared = measures.paired(*by_seed)
    interval = compared.interval if compared else None
    measured = f"{own.mean():,.0f} against {base.mean():,.0f}"
    return Target(claim, task, measured, _show(interval), at_least(interval, 0.0))


def _deployed(place: Store, task: str, column: str) -> list[Target]:
    where = f"deployed ({COLUMNS[column].label})"
    ours, base = (best(place, task, variant, column) for variant in (OURS, BASE))
    claims = [
        f"{where}: no episode ended by collision",
        f"{where}: no episode ended by a joint limit",
        f"{where}: mean return at least VICES'",
        f"{where}: success at least VICES'",
    ]
    if ours is None or base is None:
        return [Target(claim, task, "", "", None) for claim in claims]
    found = []
    for claim, name in zip(claims, ("collision", "joint_limit"), strict=False):
        rate = measures.rate(ours, name)
        measured = f"{rate.hits} of {rate.count}"
        interval = _show(rate.interval, " %")
        found.append(Target(claim, task, measured, interval, never(rate)))
    enough = len(ours) == len(base) >= EPISODES
    own, other = (measures.mean(rows, "return").mean for rows in (ours, base))
    gap = measures.gap(ours, base, "return") if enough else None
    measured = f"{own:,.0f} against {other:,.0f}"
    found.append(Target(claims[2], task, measured, _show(gap), at_least(gap, 0.0)))
    own, other = (measures.rate(rows, "success") for rows in (ours, base))
    solved = enough and max(own.hits, other.hits) > 0
    gap = measures.gap(ours, base, "success", 100.0) if solved else None
    measured = f"{own.percent:.1f} % against {other.percent:.1f} %"
    shown = _show(gap, " points")
    return [*found, Target(claims[3], task, measured, shown, at_least(gap, 0.0))]


def best(place: Store, task: str, variant: str, column: str) -> pl.DataFrame | None:
    """Deployed episodes of the best seed; None where it is not deployed there."""
    rows = measures.of(place.training, task=task, variant=variant)
    if rows.is_empty():
        return None
    seed = measures.best_seed(rows)
    found = measures.of(
        place.episodes, task=task, variant=variant, seed=seed, column=column
    )
    return None if found.is_empty() else found


def _show(interval: Interval | None, unit: str = "") -> str:
    if interval is None or not np.isfinite(interval).all():
        return ""
    low, high = interval
    digits = 0 if max(abs(low), abs(high)) >= 1000.0 else 1
    return f"[{low:,.{digits}f}, {high:,.{digits}f}]{unit}"
