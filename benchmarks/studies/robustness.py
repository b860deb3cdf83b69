"""Where safety ends: random policies under noise, delay, crowds, weak motors.

Each setting that is varied is an axis (`benchmarks.sweeps`); all others stay at their
defaults. The named failures of `benchmarks.failures` are measured too. Run as
``python -m benchmarks.robustness --json FILE --plot FILE --docs docs/robustness.md``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.common import Row, insert, markdown, other_rows, show, write_json
from benchmarks.png import save_figure
from benchmarks.studies import failures
from benchmarks.studies.random_policies import NEAR, REACHING_LIMIT
from benchmarks.studies.sweeps import (
    AXES,
    CONTROLLERS,
    RANDOM,
    Axis,
    Cell,
    Outcome,
    Reaching,
    Results,
    sweep,
)
from envs.arms import JACO
from rmp_mjx import runtime


def rows_of(key: tuple[str, str, str], result: Outcome | Reaching) -> list[Row]:
    """The rows of one result."""
    name = "/".join(key)
    if isinstance(result, Reaching):
        total = result.reached + result.missed
        note = f"{result.reached} of {total}; {result.lost} lost by an event"
        return [Row(f"{name}/reached", result.share, "", note)]
    low, high = result.interval
    note = (
        f"{result.collisions} collisions, {result.limits} joint limits in "
        f"{result.steps} policy steps; 95 % interval {low:.3g}-{high:.3g}"
    )
    return [
        Row(f"{name}/events", result.rate, "1/1000 steps", note),
        Row(f"{name}/progress", result.progress, "", "along the commanded way"),
        Row(f"{name}/torque_jump_p99", result.torque_jump, "N m", "per policy step"),
        Row(f"{name}/jerk_p99", result.jerk, "rad/s^3", "per policy step"),
        Row(f"{name}/turns_near", result.turns, "1/s", f"within {100 * NEAR:g} cm"),
        Row(f"{name}/saturation", result.saturation, "", "of physics steps"),
        Row(f"{name}/unplaced", result.unplaced, "", "spheres, those left out too"),
    ]


def table(axis: Axis, results: Results) -> str:
    """An axis as a Markdown table; `smooth / hard` in one column."""
    head = [
        axis.title,
        "events per 1,000 steps, smooth / hard",
        "VICES",
        "progress",
        "torque jump p99 [N m]",
        "joint jerk p99 [10^3 rad/s^3]",
        "joint reversals near [1/s]",
        "saturated [%]",
        "via points reached [%] (VICES)",
    ]
    lines = []
    for label, cell in axis.cells.items():
        blind = cell._replace(noise=0.0, delay=0.0).name
        ours, base = (
            [results[name, controller, p] for p in (*RANDOM, "straight")]
            for name, controller in ((cell.name, "rmp_vices"), (blind, "vices"))
        )
        lines.append(
            (
                label,
                _pair(ours, _with_interval),
                _pair(base, lambda o: _round(o.rate)),
                _pair(ours, lambda o: f"{o.progress:.3f}"),
                _pair(ours, lambda o: f"{o.torque_jump:.0f}"),
                _pair(ours, lambda o: f"{1e-3 * o.jerk:.1f}"),
                _pair(ours, lambda o: f"{o.turns:.1f}"),
                _pair(ours, lambda o: f"{100 * o.saturation:.1f}"),
                f"{100 * ours[-1].share:.1f} ({100 * base[-1].share:.1f})",
            )
        )
    return markdown(head, lines)


def _pair(outcomes: Sequence[Any], text: Callable[[Outcome], str]) -> str:
    return " / ".join(text(outcome) for outcome in outcomes[: len(RANDOM)])


def _round(x: float) -> str:
    return f"{x:.2g}" if x < 100 else f"{x:.0f}"


def _with_interval(outcome: Outcome) -> str:
    low, high = outcome.interval
    return f"{_round(outcome.rate)} ({_round(low)}-{_round(high)})"


PANELS = ("noise", "spheres", "torque", "timestep")
"""Axes with a panel each; the delay has one too, a line for each speed."""


def plot(results: Results, path: Path) -> None:
    """Events over each axis: RMP-VICES with its intervals, VICES beside it."""
    figure, grid = plt.subplots(2, 3, figsize=(11, 6), layout="constrained")
    panels = dict(zip((*PANELS, "delay", "trade"), grid.flat, strict=True))
    styles = {"smooth": ("tab:blue", "o"), "hard": ("tab:red", "s")}
    for name in PANELS:
        axes, axis = panels[name], AXES[name]
        for policy, (color, marker) in styles.items():
            ours = [results[c.name, "rmp_vices", policy] for c in axis.cells.values()]
            blind = [c._replace(noise=0.0).name for c in axis.cells.values()]
            base = [results[b, "vices", policy].rate for b in blind]
            label = f"RMP-VICES, {policy}"
            _errors(
                axes, list(axis.cells), ours, color=color, marker=marker, label=label
            )
            axes.plot(base, "--", color=color, alpha=0.6, label=f"VICES, {policy}")
        axes.set_title(axis.title)
    cells = AXES["delay"].cells.values()
    moving = sorted({c.speed for c in cells if c.speed})
    for speed, color in zip(
        moving, ("tab:green", "tab:orange", "tab:red"), strict=True
    ):
        chosen = [c for c in cells if c.speed == speed]
        ours = [results[c.name, "rmp_vices", "hard"] for c in chosen]
        delays = [f"{1e3 * c.delay:g} ms" for c in chosen]
        label = f"spheres at {speed:g} m/s, hard"
        _errors(panels["delay"], delays, ours, color=color, marker="s", label=label)
        base = results[Cell(speed=speed).name, "vices", "hard"].rate
        panels["delay"].axhline(base, ls="--", color=color, alpha=0.6)
    panels["delay"].set_title("delay (dashed: VICES)")
    for controller, marker in (("rmp_vices", "o"), ("vices", "^")):
        known = [
            (o.progress, o.rate)
            for (_, who, policy), o in results.items()
            if who == controller and policy == "hard"
        ]
        label = CONTROLLERS[controller]
        panels["trade"].scatter(*zip(*known, strict=True), marker=marker, label=label)
    panels["trade"].set(title="all cells, hard", xlabel="progress")
    for axes in grid.flat:
        axes.set_yscale("symlog", linthresh=0.1)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    for axes in grid[:, 0]:
        axes.set_ylabel("events per 1,000 policy steps")
    save_figure(figure, path, dpi=150)
    plt.close(figure)


def _errors(axes, labels: list[str], outcomes, **style) -> None:
    rates = np.array([o.rate for o in outcomes])
    low, high = np.array([o.interval for o in outcomes]).T
    span = np.stack([rates - low, high - rates])
    axes.errorbar(labels, rates, span, capsize=3, **style)


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(description="Where safety ends.")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--plot", type=Path, help="events over the axes, as a PNG")
    parser.add_argument("--docs", type=Path, help="update the tables of this page")
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    parser.add_argument("--worlds", type=int, default=32, help="worlds per policy")
    parser.add_argument("--steps", type=int, default=560, help="policy steps per world")
    parser.add_argument("--quick", action="store_true", help="a smoke test: few steps")
    parser.add_argument(
        "--axis",
        choices=tuple(AXES),
        action="append",
        help="only this axis and no failures; may be repeated (default: all)",
    )
    parser.add_argument(
        "--robot",
        default=JACO,
        help="arm, by name or path; another than the Jaco 2 has no axis `armature` "
        "and no failures",
    )
    parser.add_argument(
        "--failure",
        choices=tuple(failures.FAILURES),
        action="append",
        help="only this failure; the JSON file keeps its other rows; may be repeated",
    )
    args = parser.parse_args(argv)
    if args.failure and (args.axis or args.plot or args.robot != JACO):
        parser.error("--failure goes with --json and --docs alone")
    if args.robot != JACO:
        args.axis = args.axis or [name for name in AXES if name != "armature"]
        if "armature" in args.axis:
            parser.error("--axis armature is for the Jaco 2: leave --robot out")
    if args.axis and (args.plot or args.docs):
        parser.error("--plot and --docs need all axes: leave --axis and --robot out")
    if args.steps <= REACHING_LIMIT:
        parser.error(f"--steps must exceed {REACHING_LIMIT}, an episode's length")
    return args


def main(argv: list[str] | None = None) -> None:
    """Measure, print, and write the requested files."""
    args = parse(argv)
    runtime.configure()
    worlds, steps = (4, 320) if args.quick else (args.worlds, args.steps)
    axes = () if args.failure else args.axis or tuple(AXES)
    results = dict(sweep(axes, worlds, steps, args.seed, args.robot))
    rows = [row for key, result in results.items() for row in rows_of(key, result)]
    tables = {name: table(AXES[name], results) for name in axes}
    for name in args.failure or (() if args.axis else failures.FAILURES):
        began = time.perf_counter()
        found, tables[name] = failures.FAILURES[name](2 * worlds, args.seed)
        rows += found
        print(f"{name}: {time.perf_counter() - began:.0f} s")
    show(rows, "Where safety ends")
    if args.failure:
        rows = [*other_rows(args.json, args.failure), *rows]
    if args.json:
        settings = {"seed": args.seed, "worlds": worlds, "steps": steps}
        settings["robot"] = args.robot
        write_json(args.json, rows, **settings)
    if args.plot:
        plot(results, args.plot)
    if args.docs:
        args.docs.write_text(insert(args.docs.read_text(), tables))


if __name__ == "__main__":
    main()
