"""The command: load an arm, check it, say what was found."""

import argparse
import importlib.util
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from rmp_mjx import runtime
from rmp_mjx.check_robot.advice import about_model, about_motion
from rmp_mjx.check_robot.certificate import certify
from rmp_mjx.check_robot.coverage import LinkCoverage, coverage
from rmp_mjx.check_robot.parameters import write_parameters
from rmp_mjx.check_robot.picture import draw
from rmp_mjx.check_robot.reaches import (
    DURATION,
    FROM_END,
    PERIOD,
    Draws,
    Track,
    draw_reaches,
    greatest,
    reach_of,
    run_reaches,
)
from rmp_mjx.robot import Robot, RobotError, RobotWarning, robots
from rmp_mjx.robot.limits import recorded

_NUMBERS = ("torque_limits", "velocity_limits", "torque_rate_limits", "q_home")
_EPILOG = "Names of arms here: {}. A .toml file of --out may stand for MODEL, too."


def main(args: Sequence[str] | None = None) -> int:
    """Check one arm; returns 0, or 2 where it cannot be loaded."""
    options, console = _parser().parse_args(args), Console()
    runtime.configure()
    given = _given(options)
    try:
        with warnings.catch_warnings(record=True) as notes:
            warnings.simplefilter("always", RobotWarning)
            robot = Robot.load(options.model, **given)
        draws = draw_reaches(robot, options.reaches) if options.reaches else None
    except (RobotError, ValueError) as error:
        Console(stderr=True).print(f"error: {error}", markup=False, highlight=False)
        return 2
    _say(console, f"{robot}, reach {reach_of(robot):.2f} m")
    console.print(_joints(robot))
    errors, links = certify(robot), coverage(robot)
    for engine, terms in errors.items():
        shown = ", ".join(f"{name} {error:.0e}" for name, error in terms.items())
        _say(console, f"greatest relative errors against {engine}: {shown}")
    if "Pinocchio" not in errors and importlib.util.find_spec("pinocchio") is None:
        _say(console, "Pinocchio is not installed: not compared")
    console.print(_links(links))
    if options.picture:
        failure = draw(robot, options.picture)
        _say(console, f"no picture: {failure}" if failure else f"{options.picture}")
    findings = [str(note.message) for note in notes]
    findings += about_model(robot, errors, links)
    if draws is not None:
        track = run_reaches(robot, draws)
        console.print(_motion(robot, draws, track))
        findings += about_motion(robot, draws, track)
    _say(console, "What does not fit:" if findings else "Everything fits.")
    for finding in findings:
        _say(console, f"  * {finding}")
    if options.out:
        write_parameters(options.out, robot, options.model, given)
        _say(console, f'{options.out}: load it with Robot.load("{options.out}")')
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m rmp_mjx.check_robot",
        description="Check an arm, and the controller on it.",
        epilog=_EPILOG.format(", ".join(robots())),
    )
    add = parser.add_argument
    add("model", help="name of an arm, or path of its MJCF or parameters")
    add("--site", help="end-effector site")
    add("--body", help="body of the end effector, instead of a site")
    add("--offset", type=float, nargs=3, help="its place on the body [m]")
    add("--spacing", type=float, help="distance between control points [m]")
    for name in _NUMBERS:
        add(f"--{name}", type=float, nargs="+", help="one number for each joint")
    add("--reaches", type=int, default=200, help="random reaches; 0: none")
    add("--picture", type=Path, help="PNG of the arm and its capsules to write")
    add("--out", type=Path, help="file of parameters (.toml) to write")
    return parser


def _given(options: argparse.Namespace) -> dict[str, Any]:
    """The options of `Robot.load` that were given."""
    names = ("site", "body", "offset", "spacing", *_NUMBERS)
    return {k: v for k in names if (v := getattr(options, k)) is not None}


def _joints(robot: Robot) -> Table:
    table = _table("joint", "type", "range", "home", "torque", "speed", "torque rate")
    for j, name in enumerate(robot.joint_names):
        table.add_row(
            name,
            "hinge" if robot.hinge[j] else "slide",
            f"{robot.q_lower[j]:.2f} to {robot.q_upper[j]:.2f}",
            f"{robot.q_home[j]:.2f}",
            f"{robot.tau_max[j]:g}",
            "?" if robot.qd_max is None else f"{robot.qd_max[j]:.2f}",
            "?" if robot.tau_rate_max is None else f"{robot.tau_rate_max[j]:g}",
        )
    return table


def _links(links: list[LinkCoverage]) -> Table:
    table = _table("link", "capsules", "volume / hull", "outside", "farthest [mm]")
    for link in links:
        meshes = np.isfinite(link.ratio)
        table.add_row(
            link.body,
            str(link.capsules),
            f"{link.ratio:.2f}" if meshes else "no mesh",
            f"{link.outside:.1%}",
            f"{1000 * link.farthest:.1f}",
        )
    return table


def _motion(robot: Robot, draws: Draws, track: Track) -> Table:
    table = _table("on reaches", "", title=f"{len(draws.goal)} random reaches")
    reached, blocked = np.asarray(track.nearest) < draws.radius, draws.blocked
    ends = np.any(track.room < FROM_END, axis=1)
    table.add_row("a sphere in the way: reached", _share(reached[blocked]))
    table.add_row("no sphere: reached", _share(reached[~blocked]))
    table.add_row("contacts with the sphere", str(np.count_nonzero(track.touched)))
    table.add_row("self-collisions", str(np.count_nonzero(track.crossed)))
    table.add_row(f"a joint within {FROM_END} of its end", str(np.count_nonzero(ends)))
    limits = recorded(robot.mj_model)
    for what, seen, limit in (
        ("speed", track.speed, robot.qd_max),
        ("acceleration", track.acceleration, limits.get("acceleration_limits")),
        ("torque rate", track.rate, robot.tau_rate_max),
    ):
        most = greatest(seen)
        text = f"{most.max():.1f}, no limit known"
        if limit is not None:
            text = f"{np.max(most / limit):.2f} of the limit"
        table.add_row(f"greatest {what}", text)
    limited = float(np.mean(track.limited)) * PERIOD / DURATION
    table.add_row("time with a motor at its limit", f"{limited:.1%}")
    return table


def _share(flags: np.ndarray) -> str:
    return f"{np.count_nonzero(flags)} of {len(flags)}"


def _table(*columns: str, title: str | None = None) -> Table:
    table = Table(title=title)
    for column in columns:
        table.add_column(column)
    return table


def _say(console: Console, line: str) -> None:
    console.print(line, markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    sys.exit(main())
