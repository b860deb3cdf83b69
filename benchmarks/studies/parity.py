"""Our PPO loop beside Brax's own, on the same tasks, both tuned with the same budget.

`python -m benchmarks.parity --json F --plot P`. Both loops are what `train.py` runs
with `--trainer ours` and `--trainer brax`: the same networks, environments, iterations,
passes and minibatches. Each has four trials: two learning rates of the policy, times
two values of what the value function needs, which is a learning rate of its own with us
and a factor on the rewards with Brax. Brax has one learning rate; in one trial it
follows the KL divergence, in the other it is larger and fixed. The trials have a seed
of their own; the seeds that are reported are trained afterwards. Policies are judged at
equal distances, by their mean actions, on the same starts.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console

import envs
from benchmarks.common import machine
from benchmarks.png import save_figure
from envs.types import State
from rmp_mjx import runtime
from rmp_mjx.metric import Metric
from rmp_mjx.training.brax import trainer
from rmp_mjx.training.config import PPOConfig, RunConfig, TrainConfig
from rmp_mjx.training.evaluation import evaluate
from rmp_mjx.training.runs import loop, policies, run_folder
from rmp_mjx.training.stats import bootstrap_curve, bootstrap_mean, interquartile_mean

Which = Literal["ours", "brax"]
"""One of the loops."""
TASKS = ("reach", "trajectory")
"""Tasks that the loops can be compared on."""
LOOPS: dict[Which, str] = {"ours": "#2a6fbb", "brax": "#c0504d"}
"""The two loops and their colours."""
TRAIN = {"ours": loop.train, "brax": trainer.train}
"""What trains."""
SIZES: dict[str, Any] = {"num_envs": 128}
"""What both loops are given besides the defaults of `train.py`."""
RATES: dict[str, tuple[dict[str, float], ...]] = {
    "ours": ({"learning_rate": 3e-4}, {"learning_rate": 1e-3}),
    "brax": ({"learning_rate": 3e-4}, {"learning_rate": 1e-3, "target_kl": 0.0}),
}
"""Learning rates that are tried."""
VALUES: dict[str, tuple[str, dict[str, tuple[float, ...]]]] = {
    "ours": (
        "value_learning_rate",
        {"reach": (1e-3, 3e-3), "trajectory": (1e-3, 3e-3)},
    ),
    "brax": ("reward_scaling", {"reach": (1.0, 0.1), "trajectory": (1e-3, 1e-2)}),
}
"""What else is tried, and its values by task: rewards are about 1 and about 30."""
TUNING_SEED = 100
"""Seed of the trials; those reported are 0, 1, ..."""
EVAL_EPISODES = 64
"""Episodes of each evaluation."""


class Reach:
    """A point in a square of 2 m, moved by its velocity, to be brought to a goal."""

    observation_size, action_size = 4, 2
    dt, episode_length = 0.05, 50
    metrics = {"distance": Metric("distance", "last", unit="m")}  # noqa: RUF012
    options = SimpleNamespace(physics="none")

    def reset(self, rng):
        """Point and goal anywhere in the square."""
        return self._state(*jax.random.uniform(rng, (2, 2), minval=-1.0))

    def step(self, state, action):
        """Move at up to 2 m/s along each axis; there are walls."""
        x, goal = state.data
        x = x + 2.0 * self.dt * jnp.clip(action, -1.0, 1.0)
        return self._state(jnp.clip(x, -1.0, 1.0), goal)

    def _state(self, x, goal):
        distance = jnp.linalg.norm(x - goal)
        return State(
            data=(x, goal),  # pyright: ignore[reportArgumentType]
            obs=jnp.concatenate([x, goal]),
            reward=1.0 - distance,
            done=jnp.zeros(()),
            metrics={"distance": distance},
            info={},
        )


@dataclass(frozen=True)
class ReachOptions:
    """What the record of a run on `Reach` says."""

    title: str = "reach"
    """The task's name."""

    def record(self) -> dict[str, Any]:
        """There are no options."""
        return {"env": self.title}


Judge = Callable[[Any], float]
"""Mean return of an agent's episodes."""
Curve = list[tuple[int, float]]
"""Policy steps and mean return of an episode."""


def load(name: str) -> tuple[Any, Any]:
    """A task, and what its configuration says of it.

    Trajectory following is run with VICES and episodes of 256 steps, a quarter of the
    usual length, to save time.
    """
    if name == "reach":
        return Reach(), ReachOptions()
    task = envs.load(name, controller="vices", episode_length=256)
    return task, task.options


def train(
    which: Which, task: Any, options: Any, judge: Judge, points: int, **given: Any
) -> Curve:
    """Train with one of the loops and judge the policies that it saves on the way."""
    with tempfile.TemporaryDirectory() as folder:
        config = TrainConfig(options, PPOConfig(), RunConfig(), trainer=which)
        config = config.replace(**SIZES, **given, run_dir=folder)
        each = config.num_iterations // points
        config = config.replace(checkpoint_interval=each, keep_every=each)
        _, lock = run_folder.open_run(config)
        with lock:
            TRAIN[which](task, config, Path(folder), Console(quiet=True))
        curve = []
        for done in range(each, config.num_iterations + 1, each):
            _, agent = policies.load_agent(
                task, config, Path(folder), True, print, checkpoint=str(done)
            )
            curve.append((done * config.ppo.steps_per_iteration, judge(agent)))
    return curve


def trials(which: Which, task: str) -> list[dict[str, float]]:
    """The settings that a loop is tried with: every rate with every value."""
    name, values = VALUES[which]
    return [
        {**rate, name: value}
        for rate, value in itertools.product(RATES[which], values[task])
    ]


def compare(name: str, steps: int, seeds: int, points: int) -> dict[str, Any]:
    """Tune both loops on a task and train them with every seed."""
    task, options = load(name)
    size = SIZES["num_envs"] * PPOConfig().unroll_length * points
    steps = -(-steps // size) * size  # evaluations fall on the same steps
    recorded = evaluate.recorder(task, EVAL_EPISODES, 0)

    def judge(agent):
        return float(recorded(agent, jax.random.key(1000))[0]["return"].mean())

    found: dict[str, Any] = {"seeds": seeds}
    for which in LOOPS:
        tried = []
        for setting in trials(which, name):
            given = {"num_timesteps": steps, "seed": TUNING_SEED, **setting}
            curve = train(which, task, options, judge, 1, **given)
            tried.append({**setting, "return": curve[-1][1]})
            print(f"{name}, {which}, tried: {tried[-1]}", flush=True)
        best = max(tried, key=lambda trial: trial["return"])
        chosen = {key: value for key, value in best.items() if key != "return"}
        curves = [
            train(
                which,
                task,
                options,
                judge,
                points,
                num_timesteps=steps,
                seed=seed,
                **chosen,
            )
            for seed in range(seeds)
        ]
        found[which] = {"trials": tried, "chosen": chosen, **summary(curves)}
        last, low, high = found[which]["last"]
        print(f"{name}, {which}: last return {last:.4g} [{low:.4g}, {high:.4g}]")
    return found


def summary(curves: Sequence[Curve]) -> dict[str, Any]:
    """Over the seeds: the curve with its interval, and the last return."""
    values = np.array([[value for _, value in curve] for curve in curves])
    low, high = bootstrap_curve(values)
    last = values[:, -1]
    return {
        "steps": [step for step, _ in curves[0]],
        "return": interquartile_mean(values).tolist(),
        "low": low.tolist(),
        "high": high.tolist(),
        "last": [float(last.mean()), *bootstrap_mean(last)],
    }


def plot(results: dict[str, dict[str, Any]], path: Path) -> None:
    """One panel a task."""
    figure = Figure(figsize=(4.6 * len(results), 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.atleast_1d(figure.subplots(1, len(results)))
    for axis, (task, found) in zip(axes, results.items(), strict=True):
        for which, color in LOOPS.items():
            curve = found[which]
            x = np.array(curve["steps"]) / 1e3
            axis.fill_between(x, curve["low"], curve["high"], color=color, alpha=0.2)
            axis.plot(x, curve["return"], color=color, lw=1.4, label=which)
        axis.set_title(f"{task}, {found['seeds']} seeds", fontsize=9)
        axis.set_xlabel("policy steps [thousands]", fontsize=9)
        axis.set_ylabel("return of an episode", fontsize=9)
        axis.grid(alpha=0.3)
        axis.legend(frameon=False, fontsize=8)
    save_figure(figure, path)


def main(args: Sequence[str] | None = None) -> int:
    """Compare the loops on each task, write figure and JSON; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=TASKS, choices=TASKS)
    parser.add_argument("--steps", type=int, nargs="+", default=[60_000, 120_000])
    parser.add_argument("--seeds", type=int, nargs="+", default=[3, 3])
    parser.add_argument("--points", type=int, default=5, help="evaluations of a run")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args(args)
    runtime.configure(split_cpu=True)
    results = {
        name: compare(name, steps, seeds, options.points)
        for name, steps, seeds in zip(
            options.tasks, options.steps, options.seeds, strict=True
        )
    }
    if options.plot:
        plot(results, options.plot)
    if options.json:
        document = {
            "command": " ".join(["python", "-m", "benchmarks.parity", *sys.argv[1:]]),
            "machine": machine(),
            "sizes": SIZES,
            "results": results,
        }
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(document, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
