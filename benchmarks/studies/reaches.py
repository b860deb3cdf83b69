"""Arms that the project was not made for: are they what they say, and are they safe?

Each arm, by name and `--chains` of `random_chain`: kinematics and dynamics are
certified against MuJoCo C and Pinocchio; then VICES and RMP-VICES, both with their
defaults, make the same reaches past spheres. Run as
``python -m benchmarks.reaches --json FILE --docs docs/results/arms.md``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import rmp_mjx as rmp
from benchmarks.common import Row, insert, markdown, show, write_json
from benchmarks.studies.chains import random_chain
from envs.safety import ROUNDING
from rmp_mjx import runtime
from rmp_mjx.check_robot.certificate import certify
from rmp_mjx.check_robot.reaches import FROM_END, draw_reaches, run_reaches

CONTROLLERS = {"vices": rmp.VICES, "rmp_vices": rmp.RMPVICES}
"""What is compared, by name."""

PLANAR = "planar3"
"""An arm whose hand has too few joints for the reaches."""

CHAINS = "chains"
"""Group of the random chains."""


def arms(names: list[str], chains: int, seed: int) -> Iterator[tuple[str, rmp.Robot]]:
    """Arms by their group's name."""
    for name in names:
        yield name, rmp.Robot.load(name)
    for k in range(chains):
        yield CHAINS, random_chain(seed + k)


def judge(robot: rmp.Robot, count: int, seed: int) -> dict[str, float]:
    """Errors of the arm, and by controller how many reaches there are of each kind."""
    found = {
        f"error/{engine}": max(terms.values())
        for engine, terms in certify(robot).items()
    }
    draws = draw_reaches(robot, count, seed)
    for name, make in CONTROLLERS.items():
        track = run_reaches(robot, draws, make)
        finite = np.isfinite(track.speed).all(axis=1)
        touched, crossed = track.touched > 0, track.crossed > 0
        fast = np.zeros(count, bool)
        if robot.qd_max is not None:
            fast = np.any(track.speed > (1.0 + ROUNDING) * robot.qd_max, axis=1)
        for kind, hits in {
            "reached": track.nearest < draws.radius,
            "contact": touched | crossed,
            "joint_limit": np.any(track.room < FROM_END, axis=1),
            "joint_velocity": fast,
            "nonfinite": ~finite,
        }.items():
            found[f"{name}/{kind}"] = float(np.count_nonzero(hits))
        found["reaches"] = float(count)
    return found


def together(several: list[dict[str, float]]) -> dict[str, float]:
    """Sums over the arms of a group; greatest errors."""
    keys = dict.fromkeys(key for one in several for key in one)
    return {
        key: (max if key.startswith("error") else sum)(
            one[key] for one in several if key in one
        )
        for key in keys
    }


def rows_of(group: str, found: dict[str, float], number: int) -> list[Row]:
    """The group's figures as rows."""
    total = int(found.pop("reaches"))
    notes = {True: f"greatest of {number}", False: f"of {total} reaches"}
    return [
        Row(f"{group}/{key}", value, "", notes[key.startswith("error")])
        for key, value in found.items()
    ]


def table(rows: list[Row]) -> str:
    """A row an arm or group: VICES -> RMP-VICES."""
    found = {row.key: row for row in rows}
    titles = {
        "reached": "reached",
        "contacts, with itself included": "contact",
        "joint limits": "joint_limit",
        "faster than a limit": "joint_velocity",
    }

    def cells(group: str) -> Iterator[str]:
        yield f"`{group}`" if group != CHAINS else "random chains"
        yield found[f"{group}/vices/reached"].note.split()[1]
        for kind in titles.values():
            before, after = (
                int(found[f"{group}/{name}/{kind}"].value) for name in CONTROLLERS
            )
            yield f"{before} -> **{after}**"
        errors = [r.value for k, r in found.items() if k.startswith(f"{group}/error/")]
        yield f"{max(errors):.0e}"

    end = "/rmp_vices/reached"
    names = [key.removesuffix(end) for key in found if key.endswith(end)]
    head = ["arm", "reaches", *titles, "greatest error"]
    return markdown(head, [tuple(cells(name)) for name in names])


def main(argv: list[str] | None = None) -> None:
    """Measure, print, and write the requested files."""
    parser = argparse.ArgumentParser(description=__doc__)
    known = [name for name in rmp.robots() if name != PLANAR]
    parser.add_argument("--robots", nargs="*", default=known, help="default: all known")
    parser.add_argument(
        "--chains", type=int, default=50, help="number of random chains"
    )
    parser.add_argument("--reaches", type=int, default=24, help="of each arm")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--docs", type=Path)
    args = parser.parse_args(argv)
    runtime.configure()
    found: dict[str, list[dict[str, float]]] = {}
    for group, robot in arms(args.robots, args.chains, args.seed):
        found.setdefault(group, []).append(judge(robot, args.reaches, args.seed))
        print(group, robot.n, found[group][-1], flush=True)
    rows = [
        row
        for group, several in found.items()
        for row in rows_of(group, together(several), len(several))
    ]
    show(rows, "Reaches among spheres")
    if args.json:
        write_json(args.json, rows, reaches=args.reaches, seed=args.seed)
    if args.docs:
        text = insert(args.docs.read_text(), {"reaches": table(rows)})
        args.docs.write_text(text)


if __name__ == "__main__":
    main()
