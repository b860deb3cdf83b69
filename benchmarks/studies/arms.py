"""Policies of one arm on all others, without training: `python -m benchmarks.arms`.

A row of a table is the arm that a policy was trained with, a column the arm that it
commands; each cell is a number of whole episodes under the mean action, the same starts
in every row. Policies are TASK-rmp_vices-ARM.safetensors in a folder, the Jaco 2's
TASK-rmp_vices.safetensors. Run as
``python -m benchmarks.arms --json FILE --docs docs/results/arms.md``.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

import envs
from benchmarks.common import ROOT, Row, insert, markdown, show, write_json
from envs.arms import JACO
from rmp_mjx import runtime
from rmp_mjx.training.evaluation.evaluate import recorder
from rmp_mjx.training.policy import Policy, load_policy
from rmp_mjx.training.stats import clopper_pearson

TRAINED = (JACO, "panda", "ur5e", "iiwa14")
"""Arms with policies of their own."""

ARMS = (JACO, "panda", "fr3", "ur5e", "iiwa14")
"""Arms that are commanded."""

EVENTS = ("collision", "self_collision", "joint_limit")
"""Events that end an episode."""

COUNTED = ("joint_velocity", "torque_rate")
"""Events of the motors, which do not."""


def policies_of(task: str, folder: Path) -> dict[str, Policy]:
    """The policies of a task by the arm that they were trained with."""
    names = {arm: "" if arm == JACO else f"-{arm}" for arm in TRAINED}
    paths = {a: folder / f"{task}-rmp_vices{n}.safetensors" for a, n in names.items()}
    return {arm: load_policy(path) for arm, path in paths.items() if path.is_file()}


def judged(results: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Which episodes succeed, and in which something happens."""
    happened = {
        name: np.any([results[f"episode/{each}"] > 0 for each in group], axis=0)
        for name, group in {"event": EVENTS, "motor": COUNTED}.items()
    }
    success = results["episode/success"] > 0
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
            fastest = float(np.max(results["episode/joint_speed"]))
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
    parser.add_argument("--tasks", nargs="+", default=list(envs.names()))
    parser.add_argument("--policies", type=Path, default=ROOT / "pretrained")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=7000)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--docs", type=Path)
    args = parser.parse_args(argv)
    runtime.configure(split_cpu=True)
    rows: list[Row] = []
    for task in args.tasks:
        rows += measure(task, args.policies, args.episodes, args.seed)
        show(rows, task)
        if args.json:
            settings = {"episodes": args.episodes, "seed": args.seed}
            write_json(args.json, rows, **settings)
    text = "\n\n".join(table(task, rows) for task in args.tasks)
    print(text)
    if args.docs:
        page = insert(args.docs.read_text(), {"arms": text})
        args.docs.write_text(page)


if __name__ == "__main__":
    main()
