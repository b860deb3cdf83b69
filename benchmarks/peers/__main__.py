"""The driver: contestants take turns.

Each comparison names our measure and a peer's. All processes are started and made ready
first. Then they measure in turn, ours, theirs, ours, ..., so that a slow minute of the
machine slows both. A ratio is the median over the rounds of ours over
theirs, with its quartiles.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np

from benchmarks.common import Row, show, write_json
from benchmarks.peers import problem, venv
from benchmarks.peers.contestant import Contestant, ContestantError
from rmp_mjx import runtime


@dataclass(frozen=True)
class Peer:
    """A contestant and what it needs."""

    name: str
    """Name, in keys and of its environment."""
    module: str
    """Its file in this package."""
    requirements: tuple[str, ...]
    """Its requirements for pip."""
    xla_flags: str = ""
    """XLA flags, for a peer that runs JAX."""


@dataclass(frozen=True)
class Comparison:
    """One ratio: ours over theirs for a rate, theirs over ours for a time."""

    key: str
    """Key of the row, without the prefix ``ratio_``."""
    ours: str
    """Our measure."""
    peer: str
    """The peer's name."""
    theirs: str
    """The peer's measure."""
    note: str
    """What is compared."""
    faster_is_less: bool = False
    """Whether the measures are times."""


FLAGS = " ".join(runtime.cpu_xla_flags())
"""Our CPU flags; peers on the same release of jaxlib get them too."""

PEERS = (
    Peer(
        "robosuite",
        "robosuite_door",
        ("robosuite==1.5.2", "numpy<2", "mujoco>=3.3.7,<3.10"),
    ),
    Peer("rmp2", "rmp2_tensorflow", ("tensorflow-cpu==2.21.0", "numpy")),
    Peer(
        "arm_cbf",
        "arm_cbf",
        ("frax==0.1.0", "cbfpy==0.1.0", f"jax=={metadata.version('jax')}"),
        FLAGS,
    ),
    Peer("brax", "brax_trainer", ("brax==0.14.2", "jax==0.9.2", "flax")),
)

DOOR = (
    "door, Jaco, uniform random actions, 20 Hz; robosuite: OSC variable_kp, 25 x 2 ms"
)
TREE = "RMP2's formulation, same arm, points, spheres and leaves"

COMPARISONS = (
    *(
        Comparison(f"door_{name}", f"door_{name}", "robosuite", "env_steps", DOOR)
        for name in ("mujoco_25x2ms", "mujoco_default", "mjx_25x2ms", "mjx_default")
    ),
    Comparison("rmp2_evals", "evals_rmp2_tree", "rmp2", "evals", TREE),
    Comparison("rmp2_evals_xla", "evals_rmp2_tree", "rmp2", "evals_xla", TREE),
    Comparison(
        "rmp2_latency_xla", "latency_rmp2_tree", "rmp2", "latency_xla", TREE, True
    ),
    *(
        Comparison(
            f"{what}_{kind}",
            f"{kind}_{ours}",
            "arm_cbf",
            f"{kind}_{what}",
            f"our {ours} over {title}",
            kind == "latency",
        )
        for kind in ("evals", "latency")
        for ours, what, title in (
            ("vices", "osc", "frax's operational-space control"),
            ("rmp_vices", "osc_cbf", "the same through CBFpy's safety filter"),
        )
    ),
    Comparison(
        "brax_trainer",
        "trainer_steps",
        "brax",
        "trainer_steps",
        "PPO on a point mass, same sizes: the trainers' own cost",
    ),
)

FLOOR = {
    "c_loop": "mj_step of the trajectory scene in a Python loop, one core",
    "c_batch": "mujoco.batch of the trajectory scene, all cores",
    "mjx_step": "mjx.step of the trajectory scene, 256 environments",
    "env_physics_mujoco": "the whole environment's physics steps, C engine, 1024",
    "env_physics_mjx": "the whole environment's physics steps, MJX, 256",
}
"""Bare physics, as a lower bound of a step's cost."""


def compare(
    comparisons: Iterable[Comparison],
    ours: Contestant,
    theirs: Contestant,
    rounds: int,
    seconds: float,
) -> list[Row]:
    """Rows of one peer: its figures, ours, and their ratios."""
    comparisons = list(comparisons)
    contestants = {"ours": ours, "theirs": theirs}
    measures = dict.fromkeys(
        (who, name)
        for c in comparisons
        for who, name in (("ours", c.ours), ("theirs", c.theirs))
    )
    figures: dict[tuple[str, str], list[float]] = {m: [] for m in measures}
    for turn in range(rounds + 1):
        order = list(measures) if turn % 2 else list(reversed(measures))
        for who, name in order:
            value = contestants[who].measure(name, seconds if turn else 0.1)
            if turn:  # the first turn only makes ready
                figures[who, name].append(value)
    rows = []
    for c in comparisons:
        a, b = np.array(figures["ours", c.ours]), np.array(figures["theirs", c.theirs])
        ratios = b / a if c.faster_is_less else a / b
        low, ratio, high = np.percentile(ratios, [25, 50, 75])
        note = f"{c.note}; {rounds} rounds, quartiles {low:.3g}-{high:.3g}"
        unit = "us" if c.faster_is_less else "1/s"
        rows += [
            Row(f"ratio_{c.key}", float(ratio), "", note),
            Row(f"ours_{c.key}", float(np.median(a)), unit, c.ours),
            Row(f"peer_{c.key}", float(np.median(b)), unit, f"{c.peer}: {c.theirs}"),
        ]
    return rows


def floor(ours: Contestant, rounds: int, seconds: float) -> list[Row]:
    """Rows of bare physics."""
    figures: dict[str, list[float]] = {name: [] for name in FLOOR}
    for turn in range(rounds + 1):
        for name in FLOOR:
            value = ours.measure(name, seconds if turn else 0.1)
            if turn:
                figures[name].append(value)
    return [
        Row(f"physics_{name}", float(np.median(figures[name])), "1/s", note)
        for name, note in FLOOR.items()
    ]


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.peers", description="Ours against its peers."
    )
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--quick", action="store_true", help="a smoke test: one round")
    parser.add_argument("--rounds", type=int, default=5, help="measured rounds")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random states")
    parser.add_argument(
        "--peer",
        choices=[peer.name for peer in PEERS],
        action="append",
        help="only this peer, without the floor; may be repeated (default: all)",
    )
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    """Compare, print, and write the requested files; a peer that fails is reported."""
    args = parse(argv)
    runtime.configure()
    rounds, seconds = (1, 0.5) if args.quick else (args.rounds, 1.5)
    file = Path(tempfile.mkdtemp()) / "problem.npz"
    problem.write(file, args.seed)
    ours = Contestant("benchmarks.peers.ours")
    rows, versions, failed = [], {"ours": ours.versions}, {}
    for peer in PEERS:
        if args.peer and peer.name not in args.peer:
            continue
        print(f"{peer.name} ...", flush=True)
        try:
            python = venv.python(peer.name, peer.requirements)
            theirs = Contestant(
                f"benchmarks.peers.{peer.module}", [str(file)], python, peer.xla_flags
            )
        except (venv.NotInstalled, ContestantError) as error:
            failed[peer.name] = str(error)
            print(f"{peer.name} is left out: {error}", file=sys.stderr)
            continue
        versions[peer.name] = theirs.versions
        try:
            mine = [c for c in COMPARISONS if c.peer == peer.name]
            rows += compare(mine, ours, theirs, rounds, seconds)
            if peer.name == "rmp2":
                note = "largest, over the largest acceleration of its state, in float64"
                value = theirs.measure("disagreement", 0.0)
                rows.append(Row("rmp2_disagreement", value, "", note))
        except (venv.NotInstalled, ContestantError) as error:
            failed[peer.name] = str(error)
            print(f"{peer.name} is left out: {error}", file=sys.stderr)
        finally:
            theirs.close()
    if not args.peer:
        rows += floor(ours, rounds, seconds)
    ours.close()
    show(rows, "Ours and its peers")
    if args.json:
        settings = {"rounds": rounds, "seed": args.seed, "versions": versions}
        write_json(args.json, rows, failed=failed, **settings)


if __name__ == "__main__":
    main()
