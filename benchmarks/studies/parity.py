"""Our PPO loop beside Brax's own, on the same task with the same sizes.

`python -m benchmarks.parity --json F --plot P`. Brax 0.14.2 trains with jax up to 0.9
only: run it in an environment of that kind. Both meet the same environments, policy
steps, unrolls, minibatches and passes, and are evaluated with sampled actions over
fresh episodes at the same numbers of policy steps. What differs is each loop's own:
Brax has one optimiser for both networks, squashes actions by tanh and returns to an
episode's first state; ours has two optimisers, clips, scales value targets, and resets
anew.
"""

from __future__ import annotations

import argparse
import functools
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.training.agents.ppo import networks as brax_networks
from brax.training.agents.ppo import train as brax_ppo
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import envs
from benchmarks.common import machine
from envs.brax import BraxTask
from envs.types import State
from rmp_mjx import runtime
from rmp_mjx.metric import Metric
from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.evaluation import evaluate
from rmp_mjx.training.learning.networks import make_agent
from rmp_mjx.training.learning.ppo import make_ppo
from rmp_mjx.training.stats import bootstrap_curve, bootstrap_mean, interquartile_mean

LOOPS = {"ours": "#2a6fbb", "brax": "#c0504d"}
"""The two loops and their colours."""
SIZES = {
    "num_envs": 64,
    "unroll_length": 16,
    "num_minibatches": 4,
    "num_updates_per_batch": 4,
    "discounting": 0.97,
    "gae_lambda": 0.95,
    "learning_rate": 3e-4,
    "clipping_epsilon": 0.2,
}
"""What both loops are given."""
EVAL_ENVS = 64
"""Episodes of each evaluation."""
HIDDEN = (64, 64)
"""Hidden layers of each network."""


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


Curve = list[tuple[int, float]]
"""Policy steps and mean return of an episode."""


def train_ours(task: Any, steps: int, points: int, seed: int) -> Curve:
    """Our loop, evaluated as often as Brax's."""
    config = PPOConfig(
        seed=seed,
        hidden_sizes=HIDDEN,
        value_learning_rate=SIZES["learning_rate"],
        target_kl=0.0,
        **SIZES,
    )
    ppo = make_ppo(task, config)
    state = jax.jit(ppo.init)(jax.random.key(seed))
    iterate = jax.jit(ppo.iterate, donate_argnums=0)

    episodes = evaluate.recorder(task, EVAL_ENVS, 0)

    def mean_return(state, key):
        agent = make_agent(ppo.networks, state.normalizer, state.learner.policy, False)
        return float(episodes(agent, key)[0]["return"].mean())

    iterations = -(-steps // config.steps_per_iteration)
    curve, each = [], iterations // (points - 1)
    for done in range(iterations + 1):
        if done % each == 0:
            found = mean_return(state, jax.random.key(1000 * seed + done))
            curve.append((done * config.steps_per_iteration, found))
        if done < iterations:
            state, _, _ = iterate(state)
    return curve


def train_brax(task: Any, steps: int, points: int, seed: int) -> Curve:
    """Brax's loop."""
    curve: Curve = []
    brax_ppo.train(
        environment=BraxTask(task),
        num_timesteps=steps,
        num_evals=points,
        num_eval_envs=EVAL_ENVS,
        episode_length=task.episode_length,
        num_envs=SIZES["num_envs"],
        unroll_length=SIZES["unroll_length"],
        batch_size=SIZES["num_envs"] // SIZES["num_minibatches"],
        num_minibatches=SIZES["num_minibatches"],
        num_updates_per_batch=SIZES["num_updates_per_batch"],
        discounting=SIZES["discounting"],
        gae_lambda=SIZES["gae_lambda"],
        learning_rate=SIZES["learning_rate"],
        clipping_epsilon=SIZES["clipping_epsilon"],
        entropy_cost=0.0,
        normalize_observations=True,
        seed=seed,
        progress_fn=lambda n, m: curve.append((n, float(m["eval/episode_reward"]))),
        network_factory=functools.partial(
            brax_networks.make_ppo_networks,
            policy_hidden_layer_sizes=HIDDEN,
            value_hidden_layer_sizes=HIDDEN,
        ),
    )
    return curve


TRAINERS: dict[str, Callable[[Any, int, int, int], Curve]] = {
    "ours": train_ours,
    "brax": train_brax,
}


def summary(curves: Sequence[Curve]) -> dict[str, Any]:
    """Over the seeds: the curve with its interval, the last return, the mean of all."""
    values = np.array([[value for _, value in curve] for curve in curves])
    low, high = bootstrap_curve(values)
    last, area = values[:, -1], values.mean(axis=1)
    return {
        "steps": [step for step, _ in curves[0]],
        "return": interquartile_mean(values).tolist(),
        "low": low.tolist(),
        "high": high.tolist(),
        "last": [float(last.mean()), *bootstrap_mean(last)],
        "mean_over_training": [float(area.mean()), *bootstrap_mean(area)],
    }


def plot(results: dict[str, dict[str, Any]], path: Path) -> None:
    """One panel a task."""
    figure = Figure(figsize=(4.6 * len(results), 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.atleast_1d(figure.subplots(1, len(results)))
    for axis, (task, found) in zip(axes, results.items(), strict=True):
        for loop, color in LOOPS.items():
            curve = found[loop]
            x = np.array(curve["steps"]) / 1e3
            axis.fill_between(x, curve["low"], curve["high"], color=color, alpha=0.2)
            axis.plot(x, curve["return"], color=color, lw=1.4, label=loop)
        axis.set_title(f"{task}, {found['seeds']} seeds", fontsize=9)
        axis.set_xlabel("policy steps [thousands]", fontsize=9)
        axis.set_ylabel("return of an episode", fontsize=9)
        axis.grid(alpha=0.3)
        axis.legend(frameon=False, fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def main(args: Sequence[str] | None = None) -> int:
    """Train both loops with every seed, write figure and JSON; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--tasks", nargs="+", default=["reach"], help="`reach` or a task"
    )
    parser.add_argument("--steps", type=int, nargs="+", default=[200_000])
    parser.add_argument("--seeds", type=int, nargs="+", default=[5])
    parser.add_argument("--points", type=int, default=11)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args(args)
    if not hasattr(jax, "device_put_replicated"):
        print(f"error: Brax needs jax 0.9, this is {jax.__version__}", file=sys.stderr)
        return 2
    runtime.configure()
    results: dict[str, dict[str, Any]] = {}
    for name, steps, count in zip(
        options.tasks, options.steps, options.seeds, strict=True
    ):
        task = Reach() if name == "reach" else envs.load(name, controller="vices")
        size = SIZES["num_envs"] * SIZES["unroll_length"] * (options.points - 1)
        steps = -(-steps // size) * size  # evaluations fall on the same steps
        found = results[name] = {"seeds": count}
        for loop, train in TRAINERS.items():
            began = time.monotonic()
            curves = [train(task, steps, options.points, k) for k in range(count)]
            found[loop] = summary(curves)
            found[loop]["wall_s"] = round(time.monotonic() - began, 1)
            last, low, high = found[loop]["last"]
            print(f"{name}, {loop}: last return {last:.4g} [{low:.4g}, {high:.4g}]")
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
