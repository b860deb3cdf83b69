"""Measure the rival and ours in turn: ``python -m benchmarks.rival --json F``."""

from __future__ import annotations

import argparse
import sys
import tempfile
from importlib import metadata
from pathlib import Path

import numpy as np

from benchmarks.common import Row, show, write_json
from benchmarks.peers import venv
from benchmarks.peers.contestant import Contestant, ContestantError
from benchmarks.rival import problem
from rmp_mjx import runtime

REQUIREMENTS = (
    "numba==0.68.1",
    "torch==2.13.0",
    f"mujoco=={metadata.version('mujoco')}",
    f"numpy=={metadata.version('numpy')}",
)

CONTROLLERS = ("rmp_vices", "vices")

TOLERANCE = 1e-5
"""The torques must agree to this share of a joint's limit. Both are in float64; they
differ in the order of sums and in cancellation at the closest points."""

NOTES = {
    "training": "policy steps of PPO on trajectory, updates included",
    "env_steps": "policy steps of trajectory under random actions",
    "evals": "evaluations, batch 2048, 59 points x 5 spheres; the rival's kinematics "
    "and dynamics, which MuJoCo computes anyway, are not in it",
}


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.rival", description="Ours and the rival."
    )
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--quick", action="store_true", help="a smoke test: one round")
    parser.add_argument("--rounds", type=int, default=5, help="measured rounds")
    parser.add_argument("--seed", type=int, default=0, help="seed of the states")
    parser.add_argument(
        "--num_envs", type=int, default=256, help="environments in training"
    )
    return parser.parse_args(argv)


def agreement(theirs: Contestant) -> list[Row]:
    """Rows that show that both compute the same torques.

    Raises:
        ContestantError: They do not.
    """
    rows = []
    for name in CONTROLLERS:
        error = theirs.measure(f"disagreement_{name}", 0.0)
        if not error < TOLERANCE:
            raise ContestantError(
                f"the rival's {name} differs from ours by {error:.2g} of the torque "
                f"limits, more than {TOLERANCE:g}: it computes something else"
            )
        note = f"largest of 2048 states x 7 joints; must be below {TOLERANCE:g}"
        rows.append(Row(f"rival_disagreement_{name}", error, "of limit", note))
    return rows


def main(argv: list[str] | None = None) -> None:
    """Check the agreement, measure in turn, print, and write the requested files."""
    args = parse(argv)
    runtime.configure()
    rounds, seconds = (1, 1.0) if args.quick else (args.rounds, 3.0)
    folder = Path(tempfile.mkdtemp())
    problem.write(folder, args.seed)
    size = str(args.num_envs)
    try:
        theirs = Contestant(
            "benchmarks.rival.ppo",
            [str(folder / problem.SCENE), str(folder / problem.ARRAYS), size],
            venv.python("rival", REQUIREMENTS),
        )
        rows = agreement(theirs)
    except (venv.NotInstalled, ContestantError) as error:
        sys.exit(str(error))
    ours = Contestant("benchmarks.rival.ours", [size])
    both = {"ours": ours, "rival": theirs}
    names = [f"{what}_{name}" for what in NOTES for name in CONTROLLERS]
    figures = {(who, name): [] for name in names for who in both}
    for turn in range(rounds + 1):
        for who, name in figures if turn % 2 else reversed(figures):
            value = both[who].measure(name, seconds if turn else 0.1)
            if turn:  # the first turn only makes ready
                figures[who, name].append(value)
    for name in names:
        mine, other = (np.array(figures[who, name]) for who in both)
        low, ratio, high = np.percentile(mine / other, [25, 50, 75])
        note = NOTES[name.removesuffix("_vices").removesuffix("_rmp")]
        note += f"; {rounds} rounds, quartiles {low:.3g}-{high:.3g}"
        rows.append(Row(f"ratio_{name}", float(ratio), "", note))
        for who, values in (("ours", mine), ("rival", other)):
            rows.append(Row(f"{who}_{name}", float(np.median(values)), "1/s", ""))
    show(rows, "Ours and the rival")
    if args.json:
        versions = {who: contestant.versions for who, contestant in both.items()}
        settings = {"num_envs": args.num_envs, "rounds": rounds, "seed": args.seed}
        write_json(args.json, rows, versions=versions, **settings)
    for contestant in both.values():
        contestant.close()


if __name__ == "__main__":
    main()
