"""What demonstrations save: PPO on the block with and without them, several seeds.

`python -m benchmarks.demos --json benchmarks/results/demos.json`. The scripted expert
of `benchmarks.experts` demonstrates. What is done is disturbed and what it meant is
recorded, so that the clones see how to come back (Laskey et al., 2017, DART). `--file`
keeps the demonstrations, for `train.py --demos`. Every few iterations the mean action
of every seed's policy plays the same episodes. What counts is how many policy steps a
seed had gathered when it first solved nine of ten, at two looks in a row.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

import envs
from benchmarks.common import Row, show, write_json
from benchmarks.studies import experts
from envs.base import ArmEnv
from rmp_mjx import runtime
from rmp_mjx.training import demonstrations
from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.demonstrations import Demonstrations
from rmp_mjx.training.evaluation import evaluate
from rmp_mjx.training.learning import seeds
from rmp_mjx.training.learning.networks import make_agent

WANTED = 0.9
"""Share of the episodes that a policy must solve."""


def demonstrate(
    env: ArmEnv, act: experts.Act, episodes: int, noise: float, seed: int = 0
) -> Demonstrations:
    """Whole episodes of an expert.

    Args:
        env: The task.
        act: The expert.
        episodes: How many, all from starts of their own.
        noise: Standard deviation of what is added to what is done, not to what is
            recorded.
        seed: Of starts and noise.
    """

    def episode(key: Any):
        key_noise, key_start = jax.random.split(key)
        state = env.reset(key_start)

        def step(carry, key):
            state, memory = carry
            memory, action = act(env, state, memory)
            action = jnp.clip(action, -1.0, 1.0)
            disturbed = action + noise * jax.random.normal(key, action.shape)
            new = env.step(state, jnp.clip(disturbed, -1.0, 1.0))
            row = {
                "observation": state.obs,
                "action": action,
                "reward": new.reward,
                "done": new.done > 0.5,
                "success": new.metrics["success"] > 0.5,
            }
            return (new, memory), row

        start = state, experts.start(env, state)
        return jax.lax.scan(
            step, start, jax.random.split(key_noise, env.episode_length)
        )[1]

    keys = jax.random.split(jax.random.key(seed), episodes)
    rows = jax.tree.map(np.asarray, jax.jit(jax.vmap(episode))(keys))
    ended = np.cumsum(rows["done"], axis=1)
    kept = (ended - rows["done"]) == 0  # up to the step that ends the episode
    index, step = np.nonzero(kept)
    about = demonstrations.describe(env, f"scripted expert {act.__name__}, seed {seed}")
    return Demonstrations(
        episode=index, step=step, about=about, **{k: x[kept] for k, x in rows.items()}
    )


def curve(
    env: ArmEnv,
    config: PPOConfig,
    demos: Demonstrations | None,
    every: int,
    episodes: int,
    most: int,
) -> Iterator[tuple[int, np.ndarray]]:
    """Train all seeds; again and again the policy steps so far, and each one's success.

    Args:
        env: The task.
        config: The learning.
        demos: What the policies start from; None: from scratch.
        every: Iterations between two looks.
        episodes: Episodes of a look, the same ones for all.
        most: Policy steps after which it ends.
    """
    programs = seeds.programs(env, config)
    look = evaluate.recorder(env, episodes, 0)
    state = programs.place(programs.init(seeds.keys(config)))
    if demos is not None:
        state = programs.clone(state, demos.observation, demos.action)
    # One function for all agents: another would be compiled anew.
    act: Any = make_agent(programs.ppo.networks, None, None, True)
    for done in range(0, most // config.steps_per_iteration + 1, every):
        for _ in range(every if done else 0):
            state, data, _ = programs.gather(state)
            state, _ = programs.learn(state, data)
        parts = state.normalizer, state.learner.policy
        agents = [
            Partial(act.func, *seeds.of_seed(parts, k, config))
            for k in range(config.num_seeds)
        ]
        key = jax.random.key(config.seed + 1000)
        solved = [look(agent, key)[0]["success"].mean() for agent in agents]
        yield done * config.steps_per_iteration, np.array(solved)


def steps_to(looks: Sequence[tuple[int, np.ndarray]]) -> np.ndarray:
    """Policy steps of each seed at its first two good looks in a row; inf if none."""
    good = np.array([solved >= WANTED for _, solved in looks])
    good &= np.append(good[1:], np.zeros_like(good[:1]), axis=0)
    steps = np.array([steps for steps, _ in looks], float)
    return np.where(good.any(0), steps[good.argmax(0)], np.inf)


def rows_of(name: str, looks: Sequence[tuple[int, np.ndarray]]) -> list[Row]:
    """The figures of one way to train."""
    steps = steps_to(looks)
    note = f"policy steps to {WANTED:.0%} success; seeds: " + ", ".join(
        "never" if np.isinf(s) else f"{s:,.0f}" for s in steps
    )
    shares = "; ".join(
        f"{reached:,}: " + ", ".join(f"{s:.2f}" for s in solved)
        for reached, solved in looks
    )
    first, last = (float(looks[k][1].mean()) for k in (0, -1))
    return [
        Row(f"{name}/arrived", int(np.isfinite(steps).sum()), "seeds", note),
        Row(f"{name}/success_at_start", first, "share", "mean of the seeds"),
        Row(f"{name}/success_at_end", last, "share", f"by policy steps: {shares}"),
    ]


def study(options: argparse.Namespace) -> Iterator[list[Row]]:
    """Demonstrate, then train in both ways."""
    env = envs.load("push")
    demos = demonstrate(
        env, experts.push, options.demonstrations, options.noise, options.seed
    )
    if options.file:
        demonstrations.write(options.file, demos)
    note = f"{demos.episodes} episodes, {len(demos.step):,} steps"
    solved = [demos.success[demos.episode == k].any() for k in range(demos.episodes)]
    yield [Row("demonstrations/success", float(np.mean(solved)), "share", note)]
    config = PPOConfig(seed=options.seed, num_seeds=options.num_seeds)
    cloned = dataclasses.replace(config, demos=str(options.file))
    how = {name: getattr(options, name) for name in ("every", "episodes", "most")}
    train = partial(curve, env, **how)
    for name, ppo, used in (("demos", cloned, demos), ("scratch", config, None)):
        looks = []
        for steps, shares in train(ppo, used):
            looks.append((steps, shares))
            print(name, f"{steps:,}", np.round(shares, 2), flush=True)
        yield rows_of(name, looks)


def main(args: Sequence[str] | None = None) -> None:
    """Measure, print, and write the requested files."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="benchmarks/results/demos.json")
    parser.add_argument("--file", type=Path, help="keep the demonstrations")
    parser.add_argument("--demonstrations", type=int, default=100, help="episodes")
    parser.add_argument("--noise", type=float, default=0.3, help="of what is done")
    parser.add_argument("--seed", type=int, default=0, help="first seed")
    parser.add_argument("--num_seeds", type=int, default=5)
    parser.add_argument("--every", type=int, default=8, help="iterations between looks")
    parser.add_argument("--episodes", type=int, default=50, help="of a look")
    parser.add_argument("--most", type=int, default=330_000, help="policy steps")
    options = parser.parse_args(args)
    runtime.configure()
    rows: list[Row] = []
    for new in study(options):
        rows += new
        show(new, new[0].key.partition("/")[0])
    if options.json:
        kept = {k: v for k, v in vars(options).items() if k not in ("json", "file")}
        write_json(options.json, rows, **kept)


if __name__ == "__main__":
    main()
