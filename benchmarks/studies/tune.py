"""Tune the default leaves on all tasks at once, against random policies.

Each trial runs the smooth, hard and adversarial random policies among fixed and moving
spheres, at the door and at the block, a straight line and a trained policy to via
points, and a scripted expert at the heavy door. Two figures are minimised: the share of
VICES' events that are left, and the share of progress and reached targets that is lost.
The sampler sees the search seeds only. The report runs today's defaults and the best
trials on held-out seeds. Run as
``python -m benchmarks.tune --run RUN --trials 60 --json FILE``.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import matplotlib.pyplot as plt
import numpy as np
import optuna
from jax import Array

import envs
from benchmarks.common import Row, show, write_json
from benchmarks.png import save_figure
from benchmarks.studies import experts
from benchmarks.studies.parameters import Parameters
from benchmarks.studies.random_policies import REACHING_LIMIT, poisson
from benchmarks.studies.safety_study import Group, Study, parts_of, with_parts
from envs.arms import JACO
from envs.flags import load_config
from rmp_mjx import runtime
from rmp_mjx.training.learning.networks import Agent
from rmp_mjx.training.runs.policies import load_agent

SEARCH_SEED, REPORT_SEED = 100, 200
"""First seed of the search, and first seed of the report."""

STALLED = 200
"""Policy steps after which an unfinished trained policy counts as stalled."""

HEAVY_STARTS, HEAVY_STEPS = 16, 90
"""Starts of the expert at the heavy door, and its policy steps (it needs 60)."""


class Scene(NamedTuple):
    """One compiled experiment."""

    name: str
    """Name."""
    task: str
    """A name in `envs.names()`."""
    policies: tuple[str, ...]
    """Random policies, an equal share of the worlds each."""
    options: dict[str, Any]
    """Options of the task."""


SCENES = (
    Scene("fixed", "trajectory", ("smooth", "hard", "adversarial"), {}),
    Scene("moving", "trajectory", ("smooth", "hard"), {"obstacle_speed": 0.1}),
    Scene("door", "door", ("smooth", "hard"), {"obstacles": 0}),
    Scene("push", "push", ("smooth", "hard"), {"obstacles": 0}),
)
"""Scenes for which the default parameters are tuned."""


@dataclasses.dataclass
class Tally:
    """Counts of one controller in one scene under one policy, or reaching."""

    steps: int = 0
    """Policy steps."""
    collisions: int = 0
    """Collisions and self-collisions."""
    limits: int = 0
    """Joint-limit events."""
    commanded: float = 0.0
    """Squared length of the commanded displacements [m^2]."""
    moved: float = 0.0
    """Progress along them, times their length [m^2]."""
    jump: float = 0.0
    """Largest change of a torque in a physics step [N m]."""

    @property
    def progress(self) -> float:
        """Way along the commanded displacement in a policy step, as a share of it."""
        return self.moved / self.commanded

    def add(self, figures: dict[str, np.ndarray]) -> None:
        """Count one group's steps."""
        collisions = figures["collision"].sum() + figures["self_collision"].sum()
        self.steps += figures["collision"].size
        self.collisions += int(collisions)
        self.limits += int(figures["joint_limit"].sum())
        self.commanded += float(figures["commanded"].sum())
        self.moved += float(figures["moved"].sum())
        self.jump = max(self.jump, float(figures["torque_jump"].max()))


class Bench:
    """All scenes, compiled for one kind of controller."""

    def __init__(
        self,
        kind: str,
        worlds: int,
        steps: int,
        agent: Agent | None,
        **options: Any,
    ):
        """Build the scenes; `worlds` of each policy run for `steps` policy steps.

        Args:
            kind: Kind of controller.
            worlds: Worlds of each policy.
            steps: Policy steps of each.
            agent: The policy `trained`; None: without it.
            **options: Of every task, such as the arm.
        """
        self.studies = {}
        for scene in SCENES:
            groups = [Group(policy, worlds) for policy in scene.policies]
            if scene.name == "fixed":
                groups += [
                    Group("straight", worlds, layout, REACHING_LIMIT)
                    for layout in (None, "far", "close")
                ]
                if agent is not None:
                    groups.append(Group("trained", 3 * worlds, "close", STALLED))
            self.studies[scene.name] = Study(
                kind,
                groups,
                steps,
                task=scene.task,
                agent=agent if scene.name == "fixed" else None,
                **scene.options,
                **options,
            )
        self.heavy = envs.load("door", controller=kind, variant="heavy", **options)
        self._pull = jax.jit(self._play)

    def _play(self, parts: dict[str, Any], key: Array) -> dict[str, Array]:
        """The expert at the heavy door: metrics of every step and start."""
        return experts.rollout(
            with_parts(self.heavy, parts), experts.pull, key, HEAVY_STARTS, HEAVY_STEPS
        )

    def run(self, parameters: Parameters | None, seed: int) -> dict[str, Any]:
        """Tallies by scene and policy; figures of reaching.

        Args:
            parameters: Parameters of RMP-VICES; None for VICES.
            seed: Of everything random.
        """
        tallies: dict[str, Tally] = {}
        steps_free, reached = float("nan"), {}
        for name, study in self.studies.items():
            controller = study.env.controller
            if parameters is not None:
                # Each task rests at its own start.
                controller = parameters.controller(study.env.robot)
            for group, figures in study.run(controller, seed).items():
                if group.policy not in ("straight", "trained"):
                    tally = tallies.setdefault(f"{name}/{group.policy}", Tally())
                    tally.add(figures)
                    continue
                solved = figures["success"] > 0
                missed = figures["over"] & ~solved
                if group.policy == "trained":
                    reached["trained"] = float(solved.sum() / figures["over"].sum())
                elif group.layout is None:
                    steps_free = float(figures["age"][solved].mean() / 4)
                else:
                    hits = float(figures["via_points"].sum())
                    reached[group.layout] = hits / (hits + float(missed.sum()))
        controller = self.heavy.controller
        if parameters is not None:
            controller = parameters.controller(self.heavy.robot)
        metrics = self._pull(parts_of(controller), jax.random.key(seed))
        reached["heavy door"] = experts.solved(jax.tree.map(np.asarray, metrics))
        return {"tallies": tallies, "steps_free": steps_free, "reached": reached}


def score(ours: dict[str, Any], vices: dict[str, Any]) -> tuple[float, float]:
    """Share of VICES' events left and of its progress lost, means over the scenes.

    Missed targets among spheres and slower reaching count as lost progress.
    """
    left, lost = [], []
    for name, mine in ours["tallies"].items():
        base = vices["tallies"][name]
        for event in ("collisions", "limits"):
            theirs = getattr(base, event)
            if theirs >= 5:
                left.append(getattr(mine, event) / theirs)
        if not name.endswith("adversarial"):  # it presses against obstacles
            lost.append(max(0.0, 1.0 - mine.progress / base.progress))
    slower = max(0.0, ours["steps_free"] / vices["steps_free"] - 1.0)
    missed = sum(1.0 - share for share in ours["reached"].values())
    return float(np.mean(left)), float(np.mean(lost) + slower + missed)


def report_rows(name: str, ours: dict[str, Any], vices: dict[str, Any]) -> list[Row]:
    """The rows of one controller."""
    rows = []
    for event in ("collisions", "limits"):
        mine = sum(getattr(t, event) for t in ours["tallies"].values())
        base = sum(getattr(t, event) for t in vices["tallies"].values())
        high = poisson(mine)[1] / max(poisson(base)[0], 1e-9)
        note = f"{mine} of {base}; 95 % bound {high:.2%}"
        rows.append(Row(f"{name}/{event}_left", mine / max(base, 1), "", note))
    for scene, tally in ours["tallies"].items():
        base = vices["tallies"][scene]
        mine, theirs = (f"{t.collisions} + {t.limits}" for t in (tally, base))
        text = f"{mine} events in {tally.steps} steps; VICES {theirs}"
        ratio = tally.progress / base.progress
        rows.append(Row(f"{name}/{scene}/progress", ratio, "of VICES", text))
        note = f"VICES {base.jump:.3g}"
        rows.append(Row(f"{name}/{scene}/torque_jump", tally.jump, "N m", note))
    ratio = ours["steps_free"] / vices["steps_free"]
    rows.append(Row(f"{name}/steps_free", ratio, "of VICES", "steps per target"))
    for layout, share in ours["reached"].items():
        note = f"VICES {vices['reached'][layout]:.3f}"
        rows.append(Row(f"{name}/{layout}/reached", share, "", note))
    return rows


def plot(trials: list[dict[str, Any]], path: Path) -> None:
    """The trade-off: events left over progress lost, one point a trial."""
    figure, axes = plt.subplots(figsize=(5.2, 3.6), layout="constrained")
    left = np.array([t["left"] for t in trials])
    lost = np.array([t["lost"] for t in trials])
    axes.scatter(100 * lost, 100 * np.maximum(left, 1e-4), s=14, alpha=0.5)
    order = np.argsort(lost)
    best = np.minimum.accumulate(left[order])
    axes.step(
        100 * lost[order], 100 * np.maximum(best, 1e-4), where="post", color="tab:blue"
    )
    axes.scatter(
        100 * lost[0],
        100 * max(left[0], 1e-4),
        marker="*",
        s=120,
        color="tab:red",
        label="default leaves",
    )
    axes.set(yscale="log", xlabel="progress lost [%]", ylabel="events left [%]")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
    save_figure(figure, path, dpi=150)
    plt.close(figure)


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(description="Tune the default leaves.")
    parser.add_argument("--json", type=Path, help="write rows and trials to this file")
    parser.add_argument("--plot", type=Path, help="the trade-off, as a PNG")
    parser.add_argument("--trials", type=int, default=60)
    parser.add_argument("--minutes", type=float, help="start no trial after this")
    parser.add_argument("--worlds", type=int, default=32, help="worlds per policy")
    parser.add_argument("--steps", type=int, default=320, help="policy steps per world")
    parser.add_argument(
        "--report", type=int, default=4, help="number of held-out seeds"
    )
    parser.add_argument("--run", type=Path, help="trajectory run whose policy stalls")
    parser.add_argument("--robot", default=JACO, help="arm, by name or path")
    parser.add_argument("--armature", default="physical", help="rotor inertias")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    """Search, report, and write the requested files."""
    args = parse(argv)
    runtime.configure()
    options = {"robot": args.robot, "armature": args.armature}
    agent = policy_of(args.run, options) if args.run else None
    benches = {
        kind: Bench(kind, args.worlds, args.steps, agent, **options)
        for kind in ("vices", "rmp_vices")
    }
    baseline = benches["vices"].run(None, SEARCH_SEED)
    trials: list[dict[str, Any]] = []
    optuna.logging.set_verbosity(optuna.logging.WARNING)

    def objective(trial: optuna.Trial) -> tuple[float, float]:
        began = time.perf_counter()
        parameters = Parameters.suggest(trial)
        ours = benches["rmp_vices"].run(parameters, SEARCH_SEED)
        left, lost = score(ours, baseline)
        trials.append(dataclasses.asdict(parameters) | {"left": left, "lost": lost})
        took = time.perf_counter() - began
        print(f"{len(trials)}: left {left:.2%}, lost {lost:.1%}, {took:.0f} s")
        return left, lost

    sampler = optuna.samplers.TPESampler(seed=0, multivariate=True)
    study = optuna.create_study(directions=("minimize", "minimize"), sampler=sampler)
    study.enqueue_trial(dataclasses.asdict(Parameters()))
    study.optimize(
        objective, args.trials, timeout=60.0 * args.minutes if args.minutes else None
    )

    candidates = {"default": Parameters()}
    names = {field.name for field in dataclasses.fields(Parameters)}
    safe = [t for t in trials[1:] if t["left"] <= trials[0]["left"]]
    for i, trial in enumerate(sorted(safe, key=lambda t: t["lost"])[:2]):
        values = {name: trial[name] for name in names}
        candidates[f"trial_{i}"] = Parameters(**values)
    rows: list[Row] = []
    seeds = range(REPORT_SEED, REPORT_SEED + args.report)
    base = pooled([benches["vices"].run(None, seed) for seed in seeds])
    for name, parameters in candidates.items():
        runs = [benches["rmp_vices"].run(parameters, seed) for seed in seeds]
        rows += report_rows(name, pooled(runs), base)
    show(rows, "Held-out seeds")
    if args.plot:
        plot(trials, args.plot)
    if args.json:
        settings = {k: v for k, v in vars(args).items() if k not in ("json", "plot")}
        settings["run"] = args.run and str(args.run)
        write_json(args.json, rows, **settings)
        document = json.loads(args.json.read_text())
        document["candidates"] = {
            k: dataclasses.asdict(v) for k, v in candidates.items()
        }
        document["trials"] = trials
        args.json.write_text(json.dumps(document, indent=1) + "\n")


def policy_of(run: Path, options: dict[str, Any]) -> Agent:
    """The mean policy of a trajectory run."""
    config, env = load_config(run), envs.load("trajectory", **options)
    return load_agent(env, config, run, True, print)[1]


def pooled(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """The runs of several seeds as one."""
    first = runs[0]
    return {
        "tallies": {
            scene: _sum([run["tallies"][scene] for run in runs])
            for scene in first["tallies"]
        },
        "steps_free": float(np.mean([run["steps_free"] for run in runs])),
        "reached": {
            layout: float(np.mean([run["reached"][layout] for run in runs]))
            for layout in first["reached"]
        },
    }


def _sum(tallies: list[Tally]) -> Tally:
    total = Tally()
    for tally in tallies:
        for field in dataclasses.fields(Tally):
            old, new = getattr(total, field.name), getattr(tally, field.name)
            largest = field.name == "jump"
            setattr(total, field.name, max(old, new) if largest else old + new)
    return total


if __name__ == "__main__":
    main()
