"""Every arm under random policies, and under the policies of all others.

Random policies first: events of VICES and of RMP-VICES, each arm in its place. Then the
policies of one arm command another, without training. A row of a table is the arm that
a policy was trained with, a column the arm that it commands; each cell is a number of
whole episodes under the mean action, the same starts in every row. Policies are
TASK-rmp_vices-ARM.safetensors in a folder, the Jaco 2's TASK-rmp_vices.safetensors. Run
as ``python -m benchmarks.arms --json FILE --docs docs/results/arms.md``.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

import envs
from benchmarks.common import ROOT, Row, insert, markdown, other_rows, show, write_json
from benchmarks.studies import random_policies
from envs.arms import JACO
from envs.safety import ENDING
from rmp_mjx import runtime
from rmp_mjx.training.evaluation.evaluate import recorder
from rmp_mjx.training.policy import Policy, load_policy
from rmp_mjx.training.stats import clopper_pearson

TRAINED = (JACO, "panda", "ur5e", "iiwa14")
"""Arms with policies of their own."""

ARMS = (JACO, "panda", "fr3", "ur5e", "iiwa14")
"""Arms that are commanded."""

COUNTED = ("joint_velocity", "torque_rate")
"""Events of the motors, which do not."""


CONTROLLERS = ("vices", "rmp_vices")
"""Controllers under the random policies."""


def under_random_policies(quick: bool) -> list[Row]:
    """Events of every arm, all random policies together."""
    rows = []
    for arm in ARMS:
        names = [f"--controller={name}" for name in CONTROLLERS]
        args = random_policies.parse([f"--robot={arm}", *names, *["--quick"] * quick])
        for name, found in zip(
            CONTROLLERS, random_policies.measure_all(args), strict=True
        ):
            value = {row.key: row for row in found}
            for event in (*ENDING, "joint_velocity"):
                one = [
                    value[f"{name}_{policy}_{event}"]
                    for policy in random_policies.RANDOM
                ]
                counts = [int(row.note.split()[0]) for row in one]
                steps = [int(row.note.split()[2]) for row in one]
                note = f"{sum(counts)} in {sum(steps)} policy steps"
                rate = 1e3 * sum(counts) / sum(steps)
                rows.append(
                    Row(f"random/{arm}/{name}/{event}", rate, "1/1000 steps", note)
                )
    return rows


def random_table(rows: Sequence[Row]) -> str:
    """Events per 1,000 policy steps, VICES -> RMP-VICES."""
    found = {row.key: row.value for row in rows}
    titles = {
        "collisions, self included": ("collision", "self_collision"),
        "joint limits": ("joint_limit",),
        "joints faster than their limit": ("joint_velocity",),
    }

    def cell(arm: str, events: Sequence[str]) -> str:
        before, after = (
            sum(found[f"random/{arm}/{name}/{event}"] for event in events)
            for name in CONTROLLERS
        )
        return f"{before:.3g} -> **{after:.2g}**"

    lines = [
        (f"`{arm}`", *(cell(arm, each) for each in titles.values())) for arm in ARMS
    ]
    return markdown(["arm", *titles], lines)


def policies_of(task: str, folder: Path) -> dict[str, Policy]:
    """The policies of a task by the arm that they were trained with."""
    names = {arm: "" if arm == JACO else f"-{arm}" for arm in TRAINED}
    paths = {a: folder / f"{task}-rmp_vices{n}.safetensors" for a, n in names.items()}
    return {arm: load_policy(path) for arm, path in paths.items() if path.is_file()}


def judged(results: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Which episodes succeed, and in which something happens."""
    happened = {
        name: np.any([results[each] > 0 for each in group], axis=0)
        for name, group in {"event": ENDING, "motor": COUNTED}.items()
    }
    success = results["success"] > 0
    return {"success": success & ~happened["event"]} | happened


def measure(task: str, folder: Path, episodes: int, seed: int) -> list[Row]:
    """All cells of a task."""
    rows, policies = [], policies_of(task, folder)
    for arm in ARMS:
        env = envs.load(task, robot=arm, physics="mujoco")
        run = recorder(env, episodes, 0)
        for own, policy in policies.items():
            agent = policy.agent(env.observation_size, env.action_size, True)
            results, _ = run(agent, jax.random.key(seed))
            fastest = float(np.max(results["joint_speed"]))
            for name, hits in judged(results).items():
                low, high = clopper_pearson(int(hits.sum()), episodes)
                note = f"{hits.sum()} of {episodes}; 95 % interval "
                note += f"{100 * low:.2g} to {100 * high:.3g} %"
                rows.append(
                    Row(f"{task}/{own}/{arm}/{name}", 100.0 * hits.mean(), "%", note)
                )
            key = f"{task}/{own}/{arm}/joint_speed"
            rows.append(Row(key, fastest, "rad/s", "greatest of all"))
    return rows


def table(task: str, rows: Sequence[Row]) -> str:
    """The matrix of a task: success; events, in %."""
    found = {row.key: row.value for row in rows}
    trained = [own for own in TRAINED if f"{task}/{own}/{JACO}/success" in found]

    def cell(own: str, arm: str) -> str:
        key = f"{task}/{own}/{arm}"
        text = f"{found[f'{key}/success']:.3g}; {found[f'{key}/event']:.2g}"
        return f"**{text}**" if own == arm else text

    lines = [(f"`{own}`", *(cell(own, arm) for arm in ARMS)) for own in trained]
    head = [f"{task}: trained with", *(f"`{arm}`" for arm in ARMS)]
    return markdown(head, lines)


def main(argv: list[str] | None = None) -> None:
    """Measure, print, and write the requested files."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--parts",
        nargs="+",
        default=["random", *envs.names()],
        help="of the whole; the others are kept as they are in the JSON file",
    )
    parser.add_argument("--policies", type=Path, default=ROOT / "pretrained")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=7000)
    parser.add_argument("--quick", action="store_true", help="few random steps")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--docs", type=Path)
    args = parser.parse_args(argv)
    runtime.configure(split_cpu=True)
    known = other_rows(args.json, ())
    for part in args.parts:
        known = [row for row in known if row.key.split("/")[0] != part]
        if part == "random":
            new = under_random_policies(args.quick)
        else:
            new = measure(part, args.policies, args.episodes, args.seed)
        show(new, part)
        known += new
        if args.json:
            settings = {"episodes": args.episodes, "seed": args.seed}
            write_json(args.json, known, **settings)
    there = {row.key.split("/")[0] for row in known}
    tasks = [task for task in envs.names() if task in there]
    tables = {"arms": "\n\n".join(table(task, known) for task in tasks)}
    if "random" in there:
        tables["random"] = random_table(known)
    print(*tables.values(), sep="\n\n")
    if args.docs:
        args.docs.write_text(insert(args.docs.read_text(), tables))


if __name__ == "__main__":
    main()
