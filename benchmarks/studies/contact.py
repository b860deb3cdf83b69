"""Trained policies where contact, weak motors and moving spheres matter, part by part.

Each column is a world, each line a controller: the default one, ones with a part taken
away, the guarded one, and others. Every cell is a number of whole episodes under the
mean action, the same starts in every line. What went before each event of the default
controller is counted too. Run as
``python -m benchmarks.contact --json FILE --docs docs/ablation.md``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import envs
from benchmarks.common import ROOT, Row, insert, markdown, show, write_json
from benchmarks.studies.failures import share
from benchmarks.studies.random_policies import Clipped
from benchmarks.studies.safety_study import Group, Study
from envs.arms import JACO
from envs.cli import load_config
from envs.safety import ENDING
from rmp_mjx import RMPVICES, runtime
from rmp_mjx.training.policy import load_policy

Figures = dict[str, np.ndarray]


class World(NamedTuple):
    """A column."""

    title: str
    """Its title in the table."""
    options: dict[str, Any]
    """Options of the task."""
    group: dict[str, Any]
    """Settings of its group; see `Group`."""


WORLDS = {
    "close": World(
        "two spheres, close", {"obstacles": 4}, {"spheres": 2, "speed": 0.0}
    ),
    "moving": World("four at 0.2 m/s", {"obstacles": 4}, {"spheres": 4, "speed": 0.2}),
    "weak": World(
        "half the torque", {"obstacles": 4}, {"spheres": 2, "speed": 0.0, "torque": 0.5}
    ),
    "large": World("two of 8 cm", {"obstacles": 2, "sphere_radius": 0.08}, {}),
    "armature": World(
        "robosuite's armature", {"obstacles": 3, "armature": "robosuite"}, {}
    ),
}
"""The columns by name. Those with the same options share a compiled program."""


def _default(ctrl: RMPVICES) -> RMPVICES:
    return ctrl


def _blind(ctrl: RMPVICES) -> RMPVICES:
    return ctrl.replace(contact=_contact(ctrl, cap=0.0))


def _contact(ctrl: RMPVICES, **changes: float) -> Any:
    assert ctrl.contact is not None
    return ctrl.contact.replace(**changes)


PARTS: dict[str, tuple[str, Callable[[RMPVICES], RMPVICES]]] = {
    "all": ("all parts", _default),
    "blind": ("does not feel contacts", _blind),
    "holding": (
        "no release",
        lambda ctrl: ctrl.replace(contact=_contact(ctrl, min_weight=1.0)),
    ),
    "late": (
        "braking range without a look at the motors",
        lambda ctrl: ctrl.replace(braking_share=np.inf),
    ),
    "none": (
        "none of the three",
        lambda ctrl: _blind(ctrl).replace(braking_share=np.inf),
    ),
}
"""Controllers by name: what they are in words, and how they are made."""

OTHERS: dict[str, tuple[str, str | type[Clipped], dict[str, Any]]] = {
    "clipped": ("all, but torques clipped instead of the root limited", Clipped, {}),
    "guarded": ("all, behind the guard", "rmp_vices", {"guard": True}),
    "vices": ("VICES", "vices", {}),
    "vices_cbf": ("VICES behind the CBF filter", "vices_cbf", {}),
}
"""Controllers that need a program of their own: words, kind, options of the task."""

WORKING = 30.0
"""Mean force of the hand on its object above which it counts as at work [N]."""

CAUSES: dict[str, tuple[str, Callable[[Figures], np.ndarray]]] = {
    "still": (
        "a sphere came; the arm moved towards it at 1 cm/s at most",
        lambda now: (now["obstacle_collision"] > 0) & (now["at_fault"] == 0),
    ),
    "weak": (
        "a motor at its limit in half of the steps",
        lambda now: now["torque_saturation"] >= 0.5,
    ),
    "work": (
        "the hand pressed on its object with 30 N",
        lambda now: now["work_force"] >= WORKING,
    ),
    "sphere": ("else, at a sphere", lambda now: now["obstacle_collision"] > 0),
    "fixture": ("else, at table, fixture or object", lambda now: now["collision"] > 0),
    "else": ("joint limit or another link", lambda now: now["age"] > 0),
}
"""What went before an event, the first that is true: words, and whether it is. The
figures are those of the event's policy step; of its forces and torques, the greater of
that step and the one before."""


def judge(figures: Figures) -> Figures:
    """Success and events of the first episode of each world; (steps, worlds) each."""
    over = figures["over"].astype(bool)
    mine = np.cumsum(np.cumsum(over, axis=0) > 0, axis=0) <= 1

    def ever(name: str) -> np.ndarray:
        return np.asarray(((figures[name] > 0) & mine).any(axis=0))

    return {
        "success": ever("success"),
        "event": np.any(np.stack([ever(name) for name in ENDING]), axis=0),
        "at_fault": ever("at_fault"),
    }


def causes(figures: Figures) -> dict[str, int]:
    """How many of the first events of the worlds have which cause."""
    over = np.cumsum(figures["over"].astype(bool), axis=0) > 0
    event = np.any(np.stack([figures[name] > 0 for name in ENDING]), axis=0)
    event[1:] &= ~over[:-1]
    worlds = np.flatnonzero(event.any(axis=0))
    first = event.argmax(axis=0)[worlds]
    now = {name: values[first, worlds] for name, values in figures.items()}
    for name in ("torque_saturation", "work_force"):
        before = figures[name][np.maximum(first - 1, 0), worlds]
        now[name] = np.maximum(now[name], before)
    left, found = np.ones(len(worlds), bool), {}
    for name, (_, holds) in CAUSES.items():
        hits = left & holds(now)
        found[name], left = int(hits.sum()), left & ~hits
    return found


def rows_of(key: str, judged: Figures) -> list[Row]:
    """Rates of one cell with exact intervals."""
    shares = {name: share(hits) for name, hits in judged.items()}
    return [Row(f"{key}/{name}", x, "", note) for name, (x, note) in shares.items()]


def measure(
    task: str,
    path: Path,
    worlds: list[str],
    lines: list[str],
    episodes: int,
    seed: int,
    options: Mapping[str, Any],
) -> list[Row]:
    """All cells of one task under one policy; `options` are the task's."""
    policy, config = load_policy(path), load_config(path)
    programs: dict[str, list[str]] = {}
    for name in worlds:
        programs.setdefault(str(WORLDS[name].options), []).append(name)
    rows = []
    for names in programs.values():
        own: dict[str, Any] = {
            "layout": "close",
            "physics": "mujoco",
            "seen_spheres": config.task.seen_spheres,
        }
        own |= {**options, **WORLDS[names[0]].options}
        sample = envs.load(task, **own)
        agent = policy.agent(sample.observation_size, sample.action_size, True)
        groups = {
            name: Group("trained", episodes, limit=sample.episode_length, **more)
            for name, more in ((name, WORLDS[name].group) for name in names)
        }
        for kinds in _programs(lines):
            began = time.perf_counter()
            _, kind, more = OTHERS.get(kinds[0], ("", "rmp_vices", {}))
            study = Study(
                kind if isinstance(kind, str) else kind(sample.robot),
                list(groups.values()),
                sample.episode_length,
                task=task,
                agent=agent,
                restart=False,
                **own | more,
            )
            for line in kinds:
                made = study.env.controller
                if line in PARTS:
                    assert isinstance(made, RMPVICES)
                    made = PARTS[line][1](made)
                found = study.run(made, seed)
                for name, group in groups.items():
                    key, figures = f"{task}/{name}/{line}", found[group]
                    rows += rows_of(key, judge(figures))
                    if line == "all":
                        counts = causes(figures).items()
                        rows += [
                            Row(f"{key}/{why}", n, "", "events") for why, n in counts
                        ]
            took = time.perf_counter() - began
            print(f"{task}, {', '.join(names)}, {', '.join(kinds)}: {took:.0f} s")
    return rows


def _programs(lines: list[str]) -> list[list[str]]:
    """The lines, those together that share a compiled program."""
    together = [line for line in lines if line in PARTS]
    alone = [[line] for line in lines if line not in PARTS]
    return ([together] if together else []) + alone


def table(task: str, worlds: list[str], lines: list[str], rows: list[Row]) -> str:
    """One task as a Markdown table: a line for each controller."""
    value = {row.key: row.value for row in rows}

    def cell(world: str, line: str) -> str:
        success, event, fault = (
            100 * value[f"{task}/{world}/{line}/{name}"]
            for name in ("success", "event", "at_fault")
        )
        return f"{success:.1f}; {event:.1f} ({fault:.1f})"

    words: Mapping[str, Any] = PARTS | OTHERS
    head = (task, *(WORLDS[name].title for name in worlds))
    return markdown(head, [(words[n][0], *(cell(w, n) for w in worlds)) for n in lines])


def cause_table(task: str, worlds: list[str], rows: list[Row]) -> str:
    """How many events of all parts together have which cause."""
    value = {row.key: row.value for row in rows}
    head = (f"{task}: events of all parts", *(WORLDS[name].title for name in worlds))
    lines = [
        (words, *(f"{value[f'{task}/{world}/all/{why}']:.0f}" for world in worlds))
        for why, (words, _) in CAUSES.items()
    ]
    return markdown(head, lines)


def parse(argv: list[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    for option, known in (
        ("--tasks", envs.names()),
        ("--worlds", WORLDS),
        ("--lines", PARTS | OTHERS),
    ):
        names = list(known)
        parser.add_argument(option, nargs="+", choices=names, default=names)
    parser.add_argument("--policies", type=Path, default=ROOT / "pretrained")
    parser.add_argument("--suffix", default="rmp_vices", help="TASK-SUFFIX.safetensors")
    parser.add_argument("--robot", default=JACO, help="arm, by name or path")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=4000)
    parser.add_argument("--observer", default="momentum")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--docs", type=Path)
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    """Measure, print, and write the requested files."""
    args = parse(argv)
    runtime.configure()
    settings = vars(args) | {"policies": args.policies.name}
    settings = {k: v for k, v in settings.items() if k not in ("json", "docs")}
    rows: list[Row] = []
    for task in args.tasks:
        path = args.policies / f"{task}-{args.suffix}.safetensors"
        rows += measure(
            task,
            path,
            args.worlds,
            args.lines,
            args.episodes,
            args.seed,
            {"observer": args.observer, "robot": args.robot},
        )
        show(rows, task)
        if args.json:
            write_json(args.json, rows, **settings)
    tables = []
    for task in args.tasks:
        tables.append(table(task, args.worlds, args.lines, rows))
        if "all" in args.lines:
            tables.append(cause_table(task, args.worlds, rows))
    text = "\n\n".join(tables)
    print(text)
    if args.docs:
        args.docs.write_text(insert(args.docs.read_text(), {"contact": text}))


if __name__ == "__main__":
    main()
