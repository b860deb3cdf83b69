"""Safety under random policies, and what it costs in reaching time.

Random policies visit what a learning policy may visit, without learning. Run as
``python -m benchmarks.random_policies --json FILE``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy import stats

import rmp_mjx as rmp
from benchmarks.common import Row, show, write_json
from benchmarks.safety_study import ENDING, EVENTS, LAYOUTS, Group, Study
from rmp_mjx import runtime
from rmp_mjx.rmp.leaves import (
    Barrier,
    JointLimitBarrier,
    PaperCollision,
    RMPflowJointLimit,
    collision_transit,
)

Figures = dict[str, np.ndarray]
Make = Callable[[rmp.Robot], "rmp.RMPVICES | rmp.VICES"]

REACHING_LIMIT = 100
"""Policy steps after which a target counts as missed (5 s)."""


def _paper(robot: rmp.Robot, signs: str) -> rmp.RMPVICES:
    leaf = PaperCollision(signs=signs)
    limits = RMPflowJointLimit(robot.q_lower, robot.q_upper)
    return rmp.RMPVICES(robot, leaf, leaf, limits)


def _off(robot: rmp.Robot) -> rmp.RMPVICES:
    """No safety leaf: a barrier of no weight, which shares the compiled program."""
    off = Barrier(mu=0.0)
    limits = JointLimitBarrier(robot.q_lower, robot.q_upper, off)
    return rmp.RMPVICES(robot, off, off, limits)


def _transit(robot: rmp.Robot) -> rmp.RMPVICES:
    return rmp.RMPVICES(robot, collision_transit(), collision_transit())


CONTROLLERS: dict[str, tuple[Make, str]] = {
    "vices": (rmp.VICES, "baseline"),
    "rmp_vices": (rmp.RMPVICES, "defaults"),
    "transit": (_transit, "collision leaf for moving among obstacles"),
    "no_self_collision": (
        lambda r: rmp.RMPVICES(r, self_collision=Barrier(mu=0.0)),
        "self-collision leaf switched off",
    ),
    "no_safety": (_off, "attractors and posture only"),
    "rmpflow_limits": (
        lambda r: rmp.RMPVICES(r, joint_limit=RMPflowJointLimit(r.q_lower, r.q_upper)),
        "RMPflow's joint limiter at its authors' values",
    ),
    "paper_corrected": (
        lambda r: _paper(r, "corrected"),
        "the paper's leaves, signs corrected, RMPflow's joint limiter",
    ),
    "paper_as_printed": (
        lambda r: _paper(r, "as_printed"),
        "the paper's leaves, signs as printed, RMPflow's joint limiter",
    ),
}
"""Controllers by name: how to make one, and what it is."""


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(description="Safety under random policies.")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--quick", action="store_true", help="a smoke test: few steps")
    parser.add_argument("--seed", type=int, default=0, help="of everything random")
    parser.add_argument("--envs", type=int, default=256, help="worlds side by side")
    parser.add_argument("--steps", type=int, default=560, help="policy steps of each")
    parser.add_argument("--physics", choices=("mujoco", "mjx"), default="mujoco")
    parser.add_argument("--sim-dt", type=float, default=0.005, help="[s]")
    parser.add_argument("--armature", default="physical", help="of the Jaco 2")
    parser.add_argument(
        "--layout", choices=LAYOUTS, default="box", help="spheres, random policies"
    )
    parser.add_argument(
        "--controller",
        choices=tuple(CONTROLLERS),
        action="append",
        help="only this controller; may be repeated (default: all)",
    )
    parser.add_argument(
        "--go-on", action="store_true", help="an event does not end the episode"
    )
    return parser.parse_args(argv)


def groups(envs: int, layout: str) -> list[Group]:
    """3/8 of the worlds for each random policy, 1/8 each to reach with and without."""
    share = max(envs // 8, 1)
    return [
        Group("smooth", layout, 3 * share, 1024),
        Group("hard", layout, 3 * share, 1024),
        Group("straight", None, share, REACHING_LIMIT, True),
        Group("straight", "far", share, REACHING_LIMIT, True),
    ]


def poisson(count: int) -> tuple[float, float]:
    """Exact 95 % interval of a Poisson count's mean (Garwood, 1936)."""
    low = stats.chi2.ppf(0.025, 2 * count) / 2 if count else 0.0
    return float(low), float(stats.chi2.ppf(0.975, 2 * count + 2) / 2)


def safety_rows(name: str, policy: str, figures: Figures) -> list[Row]:
    """Event rates and what else a random policy showed of a controller."""
    steps = figures["collision"].size
    rows = []
    for event in (*EVENTS, "nonfinite"):
        count = int(figures[event].sum())
        low, high = (1e3 * bound / steps for bound in poisson(count))
        note = f"{count} in {steps} policy steps; 95 % interval {low:.3g}-{high:.3g}"
        rate = 1e3 * count / steps
        rows.append(Row(f"{name}_{policy}_{event}", rate, "1/1000 steps", note))
    progress = figures["moved"].sum() / figures["asked"].sum()
    jump = figures["jump"]
    worst = f"policy step's largest; worst of all {jump.max():.3g}"
    for key, value, unit, note in (
        ("progress", progress, "", "moved along the commanded displacement in a step"),
        ("speed", figures["speed"].mean(), "m/s", "end effector, mean"),
        ("saturation", figures["saturation"].mean(), "", "share of physics steps"),
        ("torque_jump_p99", np.quantile(jump, 0.99), "N m", worst),
        (
            "reversals",
            figures["reversals"].mean(),
            "1/step",
            "physics steps in which a torque turns round by > 1 N m",
        ),
        ("force_peak", figures["force"].max(), "N", "worst contact"),
    ):
        rows.append(Row(f"{name}_{policy}_{key}", float(value), unit, note))
    return rows


def reaching_rows(name: str, scene: str, figures: Figures) -> list[Row]:
    """How many targets were reached, and how fast."""
    over, age = figures["over"].astype(bool), figures["age"]
    event = sum(figures[e] for e in ENDING) > 0
    # Targets that a run's end cuts short would bias: only starts with time left count.
    started = np.arange(len(age))[:, None] - age
    whole = over & (started < len(age) - REACHING_LIMIT)
    reached = whole & (figures["error"] < 0.05) & ~event
    targets, hits = int(whole.sum()), int(reached.sum())
    lost = int((whole & event).sum())
    if not hits:
        return []
    took = age[reached]
    error = took.std(ddof=1) / np.sqrt(hits) if hits > 1 else np.inf
    note = f"{hits} of {targets}; {lost} ended by an event"
    spread = f"median {np.median(took):g}, standard error {error:.2g}, {hits} targets"
    return [
        Row(f"{name}_{scene}_reached", hits / targets, "", note),
        Row(f"{name}_{scene}_steps", float(took.mean()), "steps", spread),
    ]


def measure_all(args: argparse.Namespace) -> Iterator[list[Row]]:
    """The rows of one controller after the other."""
    robot = rmp.Robot.load("jaco2", armature=args.armature)
    envs, steps = (32, 120) if args.quick else (args.envs, args.steps)
    worlds = groups(envs, args.layout)
    studies: dict[type, Study] = {}
    for name in args.controller or CONTROLLERS:
        controller = CONTROLLERS[name][0](robot)
        kind = type(controller)
        if kind not in studies:
            options = {"physics": args.physics, "sim_dt": args.sim_dt}
            studies[kind] = Study(
                controller, worlds, steps, terminate=not args.go_on, **options
            )
        start = time.perf_counter()
        result = studies[kind].run(controller, args.seed)
        smooth, hard, free, among = (result[group] for group in worlds)
        new = safety_rows(name, "smooth", smooth) + safety_rows(name, "hard", hard)
        new += reaching_rows(name, "free", free)
        new += reaching_rows(name, "spheres", among)
        show(new, f"{name}: {CONTROLLERS[name][1]}")
        print(f"{time.perf_counter() - start:.0f} s")
        yield new


def main(argv: list[str] | None = None) -> None:
    """Measure, print, and write where asked to."""
    args = parse(argv)
    runtime.configure()
    settings = {k: v for k, v in vars(args).items() if k != "json"}
    rows: list[Row] = []
    for new in measure_all(args):
        rows += new
        if args.json:
            write_json(args.json, rows, **settings)


if __name__ == "__main__":
    main()
