"""Rates of rare events by subset simulation, checked by counting where that can see.

An episode of a policy's mean action is a function of its world: the start
configuration, the spheres' places and headings, and a key for the rest (the task's
goals, noise). Its level is the least clearance, 0 with an event. Subset simulation (Au
and Beck, 2001) reaches level 0 through levels that each hold a tenth of the one before.
It walks from worlds beyond one level, among them, to worlds beyond the next. Run as
``python -m benchmarks.splitting --task trajectory --json FILE``.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from scipy import stats

import envs
from benchmarks.common import Row, show, write_json
from envs.base import ArmEnv
from envs.flags import load_config
from envs.placement import keeps_clear
from envs.spheres import Course, Spheres
from envs.types import State
from rmp_mjx import runtime
from rmp_mjx.robot.kinematics import point_positions
from rmp_mjx.training.learning.networks import Agent
from rmp_mjx.training.learning.rollout import finite_step
from rmp_mjx.training.policy import load_policy
from rmp_mjx.training.runs import policies
from rmp_mjx.training.stats import Interval, clopper_pearson
from rmp_mjx.trees import select

SHARE = 0.1
"""Share of the samples beyond the next level."""
FRESH = 0.2
"""Share of moves that draw the discrete part of a world anew."""
TARGET = 0.44
"""Share of moves that should be accepted; the size of the moves follows it."""
TOUCH = 1e-6
"""Least level of an episode without an event [m]: clearance is that of control points,
which lie up to 0.8 mm inside the surface."""


class Problem(Protocol):
    """A probability of level 0 under a distribution that can be moved through."""

    def draw(self, key: Any, count: int) -> Any:
        """Independent samples, (count, ...) leading."""
        ...

    def move(self, key: Any, samples: Any, size: float) -> tuple[Any, Any]:
        """Near samples, reversible in the distribution, and which of them are valid."""
        ...

    def level(self, samples: Any) -> np.ndarray:
        """Level of each sample; 0 or less is the event."""
        ...


class Estimate(NamedTuple):
    """One run of subset simulation."""

    rate: float
    """Probability of the event; 0 if it was not reached."""
    levels: tuple[float, ...]
    """The levels on the way."""
    evaluations: int
    """Samples that were evaluated."""


def estimate(problem: Problem, key: Any, count: int = 500, most: int = 12) -> Estimate:
    """Probability of level 0 by subset simulation.

    The moves of a level start from the samples beyond it, `1 / SHARE` of each. Their
    size is changed towards a share `TARGET` of accepted moves (Papaioannou and others,
    2015).

    Args:
        problem: The problem.
        key: Key.
        count: Samples of each level.
        most: Levels at most.
    """
    key, drawn = jax.random.split(key)
    samples = problem.draw(drawn, count)
    level, used, rate, reached, size = problem.level(samples), count, 1.0, [], 0.6
    for _ in range(most):
        bound = float(np.sort(level)[round(SHARE * count) - 1])
        if bound <= 0.0:
            break
        seeds = np.flatnonzero(level <= bound)
        rate *= len(seeds) / count
        reached.append(bound)
        samples, level = jax.tree.map(lambda x, at=seeds: x[at], samples), level[seeds]
        chains, levels = [samples], [level]
        while sum(map(len, levels)) < count:
            key, proposed = jax.random.split(key)
            new, valid = problem.move(proposed, samples, size)
            found = problem.level(new)
            used += len(found)
            taken = np.asarray(valid) & (found <= bound)
            samples = select(jnp.asarray(taken), new, samples)
            level = np.where(taken, found, level)
            size = float(np.clip(size * np.exp(taken.mean() - TARGET), 0.02, 1.0))
            chains.append(samples)
            levels.append(level)
        samples = jax.tree.map(lambda *x: jnp.concatenate(x)[:count], *chains)
        level = np.concatenate(levels)[:count]
    return Estimate(rate * float(np.mean(level <= 0.0)), tuple(reached), used)


def over_repeats(rates: Sequence[float], confidence: float = 0.95) -> Interval:
    """Interval of the mean of independent runs (Student's t), 0 at least."""
    mean, error = np.mean(rates), stats.sem(rates)
    half = error * stats.t.ppf(0.5 + 0.5 * confidence, len(rates) - 1)
    return max(0.0, float(mean - half)), float(mean + half)


class Worlds(NamedTuple):
    """Worlds of episodes."""

    key: Any
    """Key of what is not a number below."""
    start: Any
    """Of the start configuration, (b, n), standard normal."""
    place: Any
    """Of the spheres' places, (b, k, 3), standard normal; the layout's rule holds."""
    heading: Any
    """Of their headings, (b, k, 3), standard normal."""


class Episodes:
    """Episodes of a policy in a task; one that is lost counts as an event."""

    def __init__(self, env: ArmEnv, agent: Agent, event: str = "collision"):
        """Compile when first used.

        Args:
            env: The task. Its spheres are of one number and one speed.
            agent: Batched agent that acts with its mean.
            event: Metric of the event.

        Raises:
            ValueError: The number of spheres or their speed is random.
        """
        options = env.options
        if (options.obstacle_count, options.obstacle_motion) != ("fixed", "always"):
            raise ValueError(
                "splitting needs obstacle_count=fixed, obstacle_motion=always"
            )
        self.env, self.agent, self.event = env, agent, event
        self._worlds = jax.jit(self._draw, static_argnums=1)
        self._moved = jax.jit(self._move)
        self._valid = jax.jit(jax.vmap(self._fits))
        self._level = jax.jit(self._play)

    def world(self, z: Worlds) -> tuple[State, Any]:
        """The start of one world's episode, and whether the layout allows it.

        A world is drawn as `reset` draws it: uniform places in the spheres' box among
        those that the layout allows.
        """
        env = self.env
        rng, _, key_task, _, _ = jax.random.split(z.key, 5)
        q = env.start_of(z.start)
        objects, task = env.begin(key_task, q)
        low, high = map(jnp.asarray, env.sphere_box)
        centers = low + (high - low) * norm.cdf(z.place)
        fits = keeps_clear(
            centers,
            env.options.sphere_radius,
            env.options.layout,
            env.keep_clear(task),
            point_positions(env.robot, q),
            jnp.asarray(env.robot.points.radius),
        )
        size = jnp.linalg.norm(z.heading, axis=-1, keepdims=True)
        velocity = env.options.obstacle_speed * z.heading / jnp.maximum(size, 1e-9)
        there = jnp.ones(len(centers), bool)
        spheres = Spheres(there, velocity, jnp.zeros((), jnp.int32))
        course = Course.at(1.0)
        start = env.opening(rng, q, objects, task, centers, spheres, course)
        return start, jnp.all(fits)

    def _fits(self, z: Worlds) -> Any:
        return self.world(z)[1]

    def draw(self, key: Any, count: int) -> Worlds:
        """Worlds that the layout allows, independent of each other."""
        kept, total = [], 0
        while total < count:
            key, drawn = jax.random.split(key)
            worlds = self._worlds(drawn, 4 * count)
            good = np.flatnonzero(np.asarray(self._valid(worlds)))
            kept.append(jax.tree.map(lambda x, at=good: x[at], worlds))
            total += len(good)
        return jax.tree.map(lambda *x: jnp.concatenate(x)[:count], *kept)

    def _draw(self, key: Any, count: int) -> Worlds:
        keys, n, k = jax.random.split(key, 4), self.env.robot.n, self.env.scene.spheres
        shapes = (count, n), (count, k, 3), (count, k, 3)
        normal = map(jax.random.normal, keys[1:], shapes)
        return Worlds(jax.random.split(keys[0], count), *normal)

    def move(self, key: Any, samples: Worlds, size: float) -> tuple[Worlds, Any]:
        """Preconditioned Crank-Nicolson moves; now and then a new discrete part."""
        new = self._moved(key, samples, size)
        return new, self._valid(new)

    def _move(self, key: Any, samples: Worlds, size: Any) -> Worlds:
        key, chosen = jax.random.split(key)
        count = samples.start.shape[0]
        fresh = self._draw(key, count)
        keep = jnp.sqrt(1.0 - size**2)
        anew = jax.random.bernoulli(chosen, FRESH, (count,))
        near = (
            keep * a + size * b for a, b in zip(samples[1:], fresh[1:], strict=True)
        )
        return Worlds(select(anew, fresh.key, samples.key), *near)

    def level(self, samples: Worlds) -> np.ndarray:
        """Least clearance of each episode [m], 0 with an event."""
        return np.asarray(self._level(samples))

    def _play(self, samples: Worlds) -> Any:
        env = self.env
        state = jax.vmap(self.world)(samples)[0]

        def go_on(carry):
            _, _, over, k = carry
            return (k < env.episode_length) & ~jnp.all(over)

        def advance(carry):
            state, level, over, k = carry
            action = self.agent(state.obs, jax.random.key(0))
            new, finite = finite_step(env, state, action)
            now = jnp.maximum(new.metrics["clearance"], TOUCH)
            now = jnp.where(finite & (new.metrics[self.event] == 0.0), now, 0.0)
            level = jnp.where(over, level, jnp.minimum(level, now))
            state = select(over, state, new)
            return state, level, over | (new.done > 0.0), k + 1

        count = samples.start.shape[0]
        start = state, jnp.full(count, jnp.inf), jnp.zeros(count, bool), 0
        return jax.lax.while_loop(go_on, advance, start)[1]


def counted(
    problem: Problem, key: Any, batches: int, lanes: int
) -> tuple[int, Interval]:
    """Events in independent samples, and the exact interval of their rate.

    Args:
        problem: The problem.
        key: Key.
        batches: Number of batches of...
        lanes: ...so many samples.
    """
    events = sum(
        int(np.sum(problem.level(problem.draw(each, lanes)) <= 0.0))
        for each in jax.random.split(key, batches)
    )
    return events, clopper_pearson(events, batches * lanes)


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="trajectory", choices=envs.names())
    parser.add_argument(
        "--policy", help="policy file or run; default: the pretrained one"
    )
    parser.add_argument("--controller", default="rmp_vices")
    parser.add_argument("--event", default="collision", help="metric of the event")
    parser.add_argument("--options", nargs="*", default=[], metavar="NAME=VALUE")
    parser.add_argument("--samples", type=int, default=500, help="of each level")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--count", type=int, default=0, help="batches of the check")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="file to write")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    """Estimate, count, report."""
    options = parse(argv)
    runtime.configure()
    began = time.monotonic()
    name = options.policy or f"pretrained/{options.task}-{options.controller}"
    problem = load(name, options.options, options.event)
    key, check = jax.random.split(jax.random.key(options.seed))
    runs = []
    for each in jax.random.split(key, options.repeats):
        runs.append(estimate(problem, each, options.samples))
        levels = ", ".join(f"{1e3 * level:.2f}" for level in runs[-1].levels)
        print(f"{runs[-1].rate:.3g}, by levels of [{levels}] mm")
    rates = [run.rate for run in runs]
    low, high = over_repeats(rates) if len(rates) > 1 else (0.0, 1.0)
    used = sum(run.evaluations for run in runs)
    note = f"95 % interval {low:.3g}-{high:.3g}; {len(runs)} runs, {used} episodes"
    rows = [Row(f"{options.task}/{options.event}", float(np.mean(rates)), "", note)]
    if options.count:
        events, bounds = counted(problem, check, options.count, options.samples)
        total = options.count * options.samples
        note = f"95 % interval {bounds[0]:.3g}-{bounds[1]:.3g}; {events} of {total}"
        rows.append(Row(f"{options.task}/counted", events / total, "", note))
    show(
        rows, f"{options.event} in an episode of {name}, {problem.env.options.spheres}"
    )
    if options.json:
        settings = {k: v for k, v in vars(options).items() if k != "json"}
        write_json(
            options.json,
            rows,
            **settings,
            rates=rates,
            levels=[run.levels for run in runs],
            seconds=time.monotonic() - began,
        )


def load(name: str, changes: Sequence[str], event: str) -> Episodes:
    """The episodes of a policy's mean action in its own task.

    Args:
        name: Policy file.
        changes: Options of the task that are not its own, `name=value`.
        event: Metric of the event.
    """
    path = policies.find(name)
    task = load_config(path).task
    changed = {}
    for change in changes:
        option, _, text = change.partition("=")
        kind = type(getattr(task, option))
        changed[option] = text.lower() == "true" if kind is bool else kind(text)
    env = envs.make(dataclasses.replace(task, physics="auto", **changed))
    agent = load_policy(path).agent(env.observation_size, env.action_size, True)
    return Episodes(env, agent, event)


if __name__ == "__main__":
    main()
