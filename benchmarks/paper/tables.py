"""Tables of the page, every number from the store."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from benchmarks.paper import measures, store, targets
from benchmarks.paper.cells import COLUMNS, PAPER, TASKS, VARIANTS
from benchmarks.paper.page import Table
from benchmarks.paper.store import Store
from envs.safety import ENDING
from rmp_mjx.training.stats import Interval

MISSING = "-"
"""What stands where nothing is measured."""

FURTHER = (
    ("success [%]", "success", 100.0),
    ("collision with the hand left out [%]", "arm_collision", 100.0),
    ("collision with a sphere [%]", "obstacle_collision", 100.0),
    ("self-collision [%]", "self_collision", 100.0),
    ("policy steps", "length", 1.0),
    ("greatest contact force [N]", "contact_force_peak", 1.0),
    ("contact impulse [N s]", "contact_impulse", 1.0),
    ("least clearance [mm]", "clearance", 1e3),
    ("joint jerk [rad/s^3]", "joint_jerk", 1.0),
    ("torque saturated [% of the time]", "torque_saturation", 100.0),
    ("spheres without a place", "unplaced_obstacles", 1.0),
    ("lost to a non-finite state [%]", "lost", 100.0),
)
"""Further measures where a task has them: label, metric, factor of its mean."""


def number(value: float) -> str:
    """A number for a table."""
    if not np.isfinite(value):
        return "n/a"
    return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


def interval(bounds: Interval | None) -> str:
    """An interval for a table."""
    return f"[{number(bounds[0])}, {number(bounds[1])}]" if bounds else MISSING


def of_targets(found: Sequence[targets.Target]) -> Table:
    """Targets with what was measured."""
    rows = [
        (
            target.claim,
            TASKS[target.task],
            target.measured or MISSING,
            target.interval or MISSING,
            target.verdict,
        )
        for target in found
    ]
    return Table(("target", "task", "measured", "95 % interval", "verdict"), rows)


def training(place: Store) -> Table:
    """Areas under the training curves and their change, beside the paper's."""
    names = {
        "return": ("episode/return", {}),
        "collisions": ("episode/collision", targets.TRAINING_DROP["collision"]),
        "joint limits": ("episode/joint_limit", targets.TRAINING_DROP["joint_limit"]),
    }
    lines = []
    for task, title in TASKS.items():
        rows = measures.of(place.training, task=task)
        for label, (name, drops) in names.items():
            found = targets.pair(rows, name)
            if found is None:
                continue
            ours, base = measures.areas(*found)
            change = measures.percent_change(ours, base)
            drop = drops.get(task)
            lines.append(
                (
                    title,
                    label,
                    number(base.mean()),
                    number(ours.mean()),
                    f"{change:+.1f} %" if np.isfinite(change) else "n/a",
                    interval(measures.change_interval(ours, base)),
                    f"{-drop:+.1f} %" if drop is not None else MISSING,
                )
            )
    header = ("task", "per episode", "VICES", "RMP-VICES", "change", "95 %", "paper")
    return Table(header, lines)


def totals(place: Store) -> Table:
    """Events per thousand policy steps over the whole of training, and its speed."""
    lines = []
    for task, title in TASKS.items():
        for variant, style in VARIANTS.items():
            rows = measures.of(place.training, task=task, variant=variant)
            if rows.is_empty():
                continue
            cells = [title, style.label, str(len(measures.seeds(rows)))]
            for name in ENDING:
                cells.append(number(float(_mean(rows, f"per_1000_steps/{name}"))))
            speed = rows["time/steps_per_s"].median()
            cells.append(number(float(speed)))  # pyright: ignore[reportArgumentType]
            lines.append(tuple(cells))
    header = (
        "task",
        "variant",
        "seeds",
        "collisions",
        "self-collisions",
        "joint limits",
        "steps/s",
    )
    return Table(header, lines)


def _mean(rows: pl.DataFrame, name: str) -> float:
    return float(rows[name].mean())  # pyright: ignore[reportArgumentType]


def deployment(place: Store, column: str) -> Table:
    """The deployment table: best seeds in a column, beside the paper's numbers."""
    lines = []
    for task, title in TASKS.items():
        for variant, style in VARIANTS.items():
            rows = targets.best(place, task, variant, column)
            if rows is None:
                continue
            returns = measures.mean(rows, "return")
            cells = [title, style.label, f"{rows['seed'][0]}", f"{len(rows)}"]
            cells.append(f"{number(returns.mean)} ± {number(returns.sd)}")
            for name in ("collision", "joint_limit", "success"):
                rate = measures.rate(rows, name)
                cells.append(f"{rate.percent:.1f} {interval(rate.interval)}")
            paper = targets.DEPLOYMENT.get(variant, {}).get(task)
            cells.append(
                f"{paper.mean:,.0f} ± {paper.sd:,.0f}; {paper.collision}; "
                f"{paper.joint_limit}"
                if paper
                else MISSING
            )
            lines.append(tuple(cells))
    header = (
        "task",
        "variant",
        "seed",
        "episodes",
        "return",
        "collision [%]",
        "joint limit [%]",
        "success [%]",
        "paper",
    )
    return Table(header, lines)


def further(place: Store, column: str) -> Table:
    """What the paper does not report: a line a measure, a column a task and variant."""
    found = {
        (task, variant): rows
        for task in TASKS
        for variant in PAPER
        if (rows := targets.best(place, task, variant, column)) is not None
    }
    lines = []
    for label, name, factor in FURTHER:
        if not any(name in rows.columns for rows in found.values()):
            continue
        cells = []
        for rows in found.values():
            if name not in rows.columns:
                cells.append(MISSING)
            elif label.endswith("[%]"):
                rate = measures.rate(rows, name)
                cells.append(f"{rate.percent:.1f} {interval(rate.interval)}")
            else:
                value = measures.mean(rows, name)
                low, high = value.interval
                bounds = interval((factor * low, factor * high))
                cells.append(f"{number(factor * value.mean)} {bounds}")
        lines.append((label, *cells))
    header = ("measure", *(f"{task}, {VARIANTS[v].label}" for task, v in found))
    return Table(header, lines)


def seeds(place: Store, column: str) -> Table:
    """Every seed in a column: success and episodes that an event ended."""
    lines = []
    for task, title in TASKS.items():
        for variant, style in VARIANTS.items():
            rows = measures.of(
                place.episodes, task=task, variant=variant, column=column
            )
            if rows.is_empty():
                continue
            each = [measures.of(rows, seed=seed) for seed in measures.seeds(rows)]
            success = (f"{measures.rate(one, 'success').percent:.0f}" for one in each)
            ended = (f"{measures.ended(one).percent:.0f}" for one in each)
            lines.append((title, style.label, ", ".join(success), ", ".join(ended)))
    header = ("task", "variant", "success [%], by seed", "ended by an event [%]")
    return Table(header, lines)


def paired(place: Store, column: str) -> Table:
    """Ours against VICES, seed by seed: training areas and deployed rates."""
    lines = []
    for task, title in TASKS.items():
        rows = measures.of(place.training, task=task)
        curves = {
            "area: return": "episode/return",
            "area: collisions": "episode/collision",
            "area: joint limits": "episode/joint_limit",
        }
        for label, name in curves.items():
            found = targets.pair(rows, name)
            if found is None:
                continue
            areas = measures.areas(*found)
            by_seed = (
                dict(zip(curve.seeds, area, strict=True))
                for curve, area in zip(found, areas, strict=True)
            )
            lines.append(_compared(title, label, measures.paired(*by_seed)))
        deployed = measures.of(place.episodes, task=task, column=column)
        for label, measure in (
            ("deployed: success [%]", lambda rows: measures.rate(rows, "success")),
            ("deployed: ended by an event [%]", measures.ended),
        ):
            by_seed = []
            for variant in (targets.OURS, targets.BASE):
                own = measures.of(deployed, variant=variant)
                by_seed.append(
                    {
                        seed: measure(measures.of(own, seed=seed)).percent
                        for seed in measures.seeds(own)
                    }
                )
            lines.append(_compared(title, label, measures.paired(*by_seed)))
    header = (
        "task",
        "measure",
        "seeds",
        "difference",
        "95 %",
        "p, t-test",
        "p, sign flips",
        "Cohen's d",
    )
    return Table(header, lines)


def _compared(task: str, label: str, found: measures.Paired | None) -> tuple[str, ...]:
    if found is None:
        return (task, label, *[MISSING] * 6)
    return (
        task,
        label,
        str(found.pairs),
        number(found.difference),
        interval(found.interval),
        f"{found.p_t:.2g}",
        f"{found.p_sign:.2g}",
        number(found.effect),
    )


def robustness(place: Store, names: tuple[str, ...]) -> Table:
    """Success and event-ended episodes of the best seeds in every column [%]."""
    lines = []
    for task, title in TASKS.items():
        for variant, style in VARIANTS.items():
            cells = []
            for name in names:
                rows = targets.best(place, task, variant, name)
                if rows is None:
                    cells.append(MISSING)
                    continue
                success, ended = measures.rate(rows, "success"), measures.ended(rows)
                cells.append(f"{success.percent:.1f}; {ended.percent:.1f}")
            if any(cell != MISSING for cell in cells):
                lines.append((title, style.label, *cells))
    return Table(("task", "variant", *(COLUMNS[n].label for n in names)), lines)


def reproduction(place: Store, column: str) -> Table:
    """What the paper found, and whether it is found here."""
    lines = []
    for task, title in TASKS.items():
        rows = measures.of(place.training, task=task)
        for name, label in (
            ("collision", "collisions"),
            ("joint_limit", "joint limits"),
        ):
            drop = targets.TRAINING_DROP[name][task]
            found = targets.change(rows, f"episode/{name}")
            if drop is None or found is None or not np.isfinite(found[0]):
                continue
            lines.append(
                (
                    f"{title}: fewer {label} in training",
                    f"{-drop:+.1f} %",
                    f"{found[0]:+.1f} %",
                    _found(found[0] < 0.0),
                )
            )
        ours, base = (
            targets.best(place, task, variant, column)
            for variant in (targets.OURS, targets.BASE)
        )
        if ours is None or base is None:
            continue
        theirs = [targets.DEPLOYMENT[v][task] for v in (targets.BASE, targets.OURS)]
        for name, label in (
            ("collision", "collisions"),
            ("joint_limit", "joint limits"),
        ):
            before, after = (getattr(entry, name) for entry in theirs)
            own = [measures.rate(found, name).percent for found in (base, ours)]
            if before > after:
                lines.append(
                    (
                        f"{title}: fewer {label} when deployed",
                        f"{before} -> {after} %",
                        f"{own[0]:.1f} -> {own[1]:.1f} %",
                        _found(own[1] < own[0]) if any(own) else "no such event",
                    )
                )
        own = [measures.mean(found, "return").mean for found in (base, ours)]
        lines.append(
            (
                f"{title}: a lower return when deployed",
                f"{theirs[0].mean:,.0f} -> {theirs[1].mean:,.0f}",
                f"{own[0]:,.0f} -> {own[1]:,.0f}",
                _found(own[1] < own[0]),
            )
        )
    return Table(("the paper's finding", "paper", "here", "found here"), lines)


def runs(place: Store) -> Table:
    """Every training run: its time and the fingerprint of its curves."""
    lines = [
        (
            f"{about['task']}/{about['variant']}/{about['seed']}",
            number(about["seconds"]),
            about["digest"],
        )
        for about in place.provenance
        if about["kind"] == store.TRAINING
    ]
    return Table(("cell", "training [s]", "fingerprint"), lines)


def _found(same: bool) -> str:
    return "yes" if same else "NO"


def events(rows: pl.DataFrame) -> Table:
    """Events by what met what."""
    kinds = ["task", "variant", "kind", "first", "second", "hand"]
    grouped = (
        rows.group_by(kinds)
        .agg(pl.len(), pl.col("force").median().alias("median"), pl.col("force").max())
        .sort(
            ["task", "variant", "len", "first", "second"],
            descending=[False, False, True, False, False],
        )
    )
    lines = [
        (
            TASKS[row["task"]],
            VARIANTS[row["variant"]].label,
            row["kind"].replace("_", " "),
            f"{row['first']} and {row['second']}",
            {True: "yes", False: "no", None: MISSING}[row["hand"]],
            str(row["len"]),
            number(row["median"]),
            number(row["force"]),
        )
        for row in grouped.iter_rows(named=True)
    ]
    header = (
        "task",
        "variant",
        "event",
        "what met what",
        "hand",
        "episodes",
        "median force [N]",
        "greatest [N]",
    )
    return Table(header, lines)
