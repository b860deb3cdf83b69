"""Safety under random policies, and its cost in reaching time.

Random policies visit what a learning policy may visit. Run as
``python -m benchmarks.random_policies --json FILE``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy import stats

import envs
import rmp_mjx as rmp
from benchmarks.common import Row, insert, markdown, show, write_json
from benchmarks.studies.safety_study import EVENTS, Group, Study
from envs.arms import JACO
from envs.placement import LAYOUTS
from envs.safety import ENDING
from rmp_mjx import runtime
from rmp_mjx.control.torque import clip_torque, torque_range
from rmp_mjx.rmp import RMP, ScalarLeaf, resolve
from rmp_mjx.rmp.leaves import (
    Barrier,
    JointLimitBarrier,
    PaperCollision,
    RMPflowJointLimit,
    collision_near,
    collision_transit,
)
from rmp_mjx.rmp.leaves.joint_limit import joint_limit_barrier

Figures = dict[str, np.ndarray]
Make = Callable[[rmp.Robot], rmp.Controller]

REACHING_LIMIT = 300
"""Policy steps after which an episode of four targets ends (15 s)."""

RANDOM = ("smooth", "hard", "adversarial")
"""Random policies, in the order of the table."""

NEAR = 0.05
"""A clearance below this counts as near an obstacle [m]."""


HOLDING = rmp.OrientationRelaxation(min_weight=1.0)
"""The orientation is never relaxed."""
STILL = rmp.SetpointDither(amplitude=0.0)
"""The set-point is never dithered."""
PLAIN: dict[str, Any] = {
    "obstacle_relaxation": HOLDING,
    "limit_relaxation": HOLDING,
    "dither": STILL,
}
"""Without our additions to the paper, in the same compiled program."""


class PrintedCollision(PaperCollision):
    """The paper's collision leaf with the signs that are printed.

    The gate is max(xd, 0) and a = +eta xd, which is wrong for a distance that is
    positive outside: the leaf acts on a body that leaves, and accelerates it.
    """

    def scalar(self, x, xd):
        """Force and metric at distances ``x`` and speeds ``xd``, elementwise."""
        return super().scalar(x, -xd)


def _with_leaves(
    robot: rmp.Robot, collision: ScalarLeaf | None = None, **changes: Any
) -> rmp.Leaves:
    """Default leaves but for these; one collision leaf for obstacles and links."""
    if collision is not None:
        changes |= {"collision": collision, "self_collision": collision}
    return rmp.Leaves.default(robot).replace(**changes)


def _paper(robot: rmp.Robot, leaf: PaperCollision) -> rmp.RMPVICES:
    limits = RMPflowJointLimit(robot.q_lower, robot.q_upper)
    return rmp.RMPVICES(robot, _with_leaves(robot, leaf, joint_limit=limits), **PLAIN)


def _off(robot: rmp.Robot) -> rmp.RMPVICES:
    """No safety leaf: barriers with zero weight, which share the compiled program."""
    off = Barrier(mu=0.0)
    limits = JointLimitBarrier(robot.q_lower, robot.q_upper, off)
    return rmp.RMPVICES(robot, _with_leaves(robot, off, joint_limit=limits), **PLAIN)


class _NoCurvature(Barrier):
    """The barrier without its geodesic term."""

    def scalar(self, x, xd):
        f, m = super().scalar(x, xd)
        gap = jnp.maximum(x - self.margin, self.x_min)
        return f - m * jnp.minimum(xd, 0.0) ** 2 / gap, m


class Clipped(rmp.RMPVICES):
    """RMP-VICES that clips each torque separately."""

    def __call__(self, q, qd, setpoint, obstacles, tau_ext=None, tau_last=None):
        """Torque for one state."""
        out = super().__call__(q, qd, setpoint, obstacles, tau_ext, tau_last)
        free = resolve(RMP(out.f, out.M), self.regularizer * out.Mq)
        low, high = torque_range(self.robot, tau_last, self.period)
        tau, limit = clip_torque(out.Mq @ free + out.bias, low, high)
        return out.replace(
            tau=tau, diagnostics=out.diagnostics | {"torque_limit": limit}
        )


def _collision(**changes: float) -> Make:
    """Default leaves with changed parameters of the collision leaves."""
    leaf = collision_near().replace(**changes)
    return lambda robot: rmp.RMPVICES(robot, _with_leaves(robot, leaf))


def _soft_wall(robot: rmp.Robot) -> rmp.RMPVICES:
    leaf, limit = (
        barrier.replace(k_out=0.05 * barrier.k_out)
        for barrier in (collision_near(), joint_limit_barrier())
    )
    limits = JointLimitBarrier(robot.q_lower, robot.q_upper, limit)
    return rmp.RMPVICES(robot, _with_leaves(robot, leaf, joint_limit=limits))


def _no_curvature(robot: rmp.Robot) -> rmp.RMPVICES:
    leaf = _NoCurvature(**vars(collision_near()))
    return rmp.RMPVICES(robot, _with_leaves(robot, leaf))


def _transit(robot: rmp.Robot) -> rmp.RMPVICES:
    return rmp.RMPVICES(robot, _with_leaves(robot, collision_transit()))


def _no_self_collision(robot: rmp.Robot) -> rmp.RMPVICES:
    return rmp.RMPVICES(robot, _with_leaves(robot, self_collision=Barrier(mu=0.0)))


def _rmpflow_limits(robot: rmp.Robot) -> rmp.RMPVICES:
    limits = RMPflowJointLimit(robot.q_lower, robot.q_upper)
    return rmp.RMPVICES(robot, _with_leaves(robot, joint_limit=limits))


CONTROLLERS: dict[str, tuple[Make, str]] = {
    "vices": (rmp.VICES, "baseline"),
    "rmp_vices": (rmp.RMPVICES, "defaults"),
    "transit": (_transit, "collision leaf for moving among obstacles"),
    "holding_orientation": (
        lambda r: rmp.RMPVICES(r, obstacle_relaxation=HOLDING),
        "orientation keeps its weight near obstacles",
    ),
    "holding_orientation_at_limits": (
        lambda r: rmp.RMPVICES(r, limit_relaxation=HOLDING),
        "orientation keeps its weight near joint limits",
    ),
    "no_stirring": (
        lambda r: rmp.RMPVICES(r, dither=STILL),
        "no set-point dither near obstacles",
    ),
    "soft_wall": (_soft_wall, "a twentieth of the stiffness inside the margins"),
    "letting_go_at_once": (
        _collision(v_out=1e-9),
        "no release speed: the metric ends with the approach",
    ),
    "no_curvature": (_no_curvature, "collision leaves without the geodesic term"),
    "no_floor": (_collision(eps=0.0), "collision leaves without the velocity floor"),
    "no_margin": (_collision(margin=0.0), "collision leaves without a margin"),
    "long_range": (_collision(r=10.0), "collision leaves without a range"),
    "clipped_torque": (Clipped, "each torque clipped separately"),
    "no_self_collision": (
        _no_self_collision,
        "self-collision leaf switched off",
    ),
    "no_safety": (_off, "attractors and posture only"),
    "rmpflow_limits": (
        _rmpflow_limits,
        "RMPflow's joint limiter at its authors' values",
    ),
    "rmp_vices_literal": (rmp.rmp_vices_literal, "the paper's formulas, no additions"),
    "paper_corrected": (
        lambda r: _paper(r, PaperCollision()),
        "the paper's leaves, signs corrected, RMPflow's joint limiter",
    ),
    "paper_as_printed": (
        lambda r: _paper(r, PrintedCollision()),
        "the paper's leaves, signs as printed, RMPflow's joint limiter",
    ),
}
"""Controllers by name: how to make one, and its description."""


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(description="Safety under random policies.")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--docs", type=Path, help="update the table of this page")
    parser.add_argument("--quick", action="store_true", help="a smoke test: few steps")
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    parser.add_argument("--envs", type=int, default=256, help="number of worlds")
    parser.add_argument("--steps", type=int, default=560, help="policy steps per world")
    parser.add_argument("--physics", choices=("mujoco", "mjx"), default="mujoco")
    parser.add_argument("--sim-dt", type=float, default=0.005, help="[s]")
    parser.add_argument("--robot", default=JACO, help="arm, by name or path")
    parser.add_argument("--armature", default="physical", help="rotor inertias")
    parser.add_argument(
        "--layout",
        choices=tuple(LAYOUTS),
        default="close",
        help="spheres, random policies",
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
    args = parser.parse_args(argv)
    if args.docs and (args.controller or args.robot != JACO):
        parser.error("--docs has the Jaco 2 under all controllers: leave both out")
    return args


def groups(count: int, layout: str) -> list[Group]:
    """2/8 of the worlds for each random policy, 1/8 for each reaching test."""
    share = max(count // 8, 1)
    return [
        *(Group(policy, 2 * share, layout) for policy in RANDOM),
        Group("straight", share, None, REACHING_LIMIT),
        Group("straight", share, "far", REACHING_LIMIT),
    ]


def poisson(count: int) -> tuple[float, float]:
    """Exact 95 % interval of a Poisson count's mean (Garwood, 1936)."""
    low = stats.chi2.ppf(0.025, 2 * count) / 2 if count else 0.0
    return float(low), float(stats.chi2.ppf(0.975, 2 * count + 2) / 2)


def safety_rows(name: str, policy: str, figures: Figures) -> list[Row]:
    """Event rates and other figures of a controller under a random policy."""
    steps = figures["collision"].size
    rows = []
    for event in (*EVENTS, "nonfinite"):
        count = int(figures[event].sum())
        low, high = (1e3 * bound / steps for bound in poisson(count))
        note = f"{count} in {steps} policy steps; 95 % interval {low:.3g}-{high:.3g}"
        rate = 1e3 * count / steps
        rows.append(Row(f"{name}_{policy}_{event}", rate, "1/1000 steps", note))
    progress = figures["moved"].sum() / figures["commanded"].sum()
    jump, near = figures["torque_jump"], figures["clearance"] < NEAR
    worst = f"policy step's largest; worst of all {jump.max():.3g}"
    turns = figures["turns"][near].sum() / max(near.sum(), 1) / 0.05
    for key, value, unit, note in (
        ("progress", progress, "", "moved along the commanded displacement in a step"),
        ("speed", figures["speed"].mean(), "m/s", "end effector, mean"),
        ("saturation", figures["torque_saturation"].mean(), "", "of physics steps"),
        ("torque_jump_p99", np.quantile(jump, 0.99), "N m", worst),
        (
            "reversals",
            figures["torque_reversals"].mean(),
            "",
            "share of physics steps in which a torque turns round by > 1 N m",
        ),
        (
            "turns_near",
            turns,
            "1/s",
            f"joint velocities that change sign, nearer than {100 * NEAR:g} cm",
        ),
        ("force_peak", figures["contact_force_peak"].max(), "N", "worst contact"),
    ):
        rows.append(Row(f"{name}_{policy}_{key}", float(value), unit, note))
    return rows


def reaching_rows(name: str, scene: str, figures: Figures) -> list[Row]:
    """Share of via points that were reached, and the time for each."""
    over, age = figures["over"].astype(bool), figures["age"]
    event = sum(figures[e] for e in ENDING) > 0
    # Episodes that a run's end cuts short would bias: only starts with time left count.
    started = np.arange(len(age))[:, None] - age
    in_time = started < len(age) - REACHING_LIMIT
    whole, solved = over & in_time, (figures["success"] > 0) & in_time
    hits = int(figures["via_points"][in_time].sum())
    missed, lost = int((whole & ~solved).sum()), int((whole & event).sum())
    if not solved.any():
        return []
    took = age[solved] / 4
    error = took.std(ddof=1) / np.sqrt(took.size) if took.size > 1 else np.inf
    note = f"{hits} of {hits + missed}; {lost} ended by an event"
    spread = f"median {np.median(took):g}, standard error {error:.2g}"
    return [
        Row(f"{name}_{scene}_reached", hits / (hits + missed), "", note),
        Row(f"{name}_{scene}_steps", float(took.mean()), "steps per target", spread),
    ]


def arm_of(name: str, armature: str) -> rmp.Robot:
    """The Jaco 2 at its own `q_home`, or an arm as the task sets it up."""
    if name == JACO:
        return rmp.Robot.load(JACO, armature=armature)
    return envs.load("trajectory", robot=name, armature=armature).robot


def measure_all(args: argparse.Namespace) -> Iterator[list[Row]]:
    """The rows of one controller after the other."""
    robot = arm_of(args.robot, args.armature)
    count, steps = (32, 320) if args.quick else (args.envs, args.steps)
    worlds = groups(count, args.layout)
    studies: dict[type, Study] = {}
    for name in args.controller or CONTROLLERS:
        controller = CONTROLLERS[name][0](robot)
        kind = type(controller)
        if kind not in studies:
            studies[kind] = Study(
                controller,
                worlds,
                steps,
                robot=robot if args.robot == JACO else args.robot,
                physics=args.physics,
                sim_dt=args.sim_dt,
                terminate_on_event=not args.go_on,
            )
        start = time.perf_counter()
        result = studies[kind].run(controller, args.seed)
        *random, free, among = (result[group] for group in worlds)
        new = []
        for group, figures in zip(worlds, random, strict=False):
            new += safety_rows(name, group.policy, figures)
        new += reaching_rows(name, "free", free)
        new += reaching_rows(name, "spheres", among)
        show(new, f"{name}: {CONTROLLERS[name][1]}")
        print(f"{time.perf_counter() - start:.0f} s")
        yield new


def table(rows: list[Row]) -> str:
    """The ablation as a Markdown table, one line per controller."""
    value = {row.key: row.value for row in rows}

    def cell(name: str, policies: tuple[str, ...], *keys: str, digits: int = 2) -> str:
        sums = [sum(value[f"{name}_{p}_{key}"] for key in keys) for p in policies]
        return " / ".join(f"{float(f'{each:.{digits}g}'):g}" for each in sums)

    head = (
        "",
        "collisions, self included, per 1,000 steps",
        "joint limits per 1,000 steps",
        "progress, smooth / hard",
        "torque jump p99 [N m], hard / adversarial",
        "steps to a via point among spheres",
    )
    lines = [
        (
            f"`{name}`: {what}",
            cell(name, RANDOM, "collision", "self_collision"),
            cell(name, RANDOM, "joint_limit"),
            cell(name, RANDOM[:2], "progress", digits=3),
            cell(name, RANDOM[1:], "torque_jump_p99"),
            f"{value.get(f'{name}_spheres_steps', np.nan):.1f}".replace("nan", "-"),
        )
        for name, (_, what) in CONTROLLERS.items()
    ]
    return markdown(head, lines)


def main(argv: list[str] | None = None) -> None:
    """Measure, print, and write the requested files."""
    args = parse(argv)
    runtime.configure()
    settings = {k: v for k, v in vars(args).items() if k not in ("json", "docs")}
    rows: list[Row] = []
    for new in measure_all(args):
        rows += new
        if args.json:
            write_json(args.json, rows, **settings)
    if args.docs:
        args.docs.write_text(insert(args.docs.read_text(), {"ablation": table(rows)}))


if __name__ == "__main__":
    main()
