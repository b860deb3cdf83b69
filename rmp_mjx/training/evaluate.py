"""Evaluation: parallel episodes, one each, and what they say."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import PRNGKeyArray

from rmp_mjx.training import episodes, recording
from rmp_mjx.training.networks import Agent
from rmp_mjx.training.recording import Recording
from rmp_mjx.training.rollout import Env, cast_like, finite_step, select
from rmp_mjx.training.stats import (
    bootstrap_mean,
    clopper_pearson,
    interquartile_mean,
    mean_sd,
)

Episodes = dict[str, np.ndarray]
"""One value per episode: `return`, `length`, `lost` (non-finite), and every metric."""


def run_episodes(
    env: Env, agent: Agent, num_episodes: int, key: PRNGKeyArray
) -> Episodes:
    """Run episodes in parallel, each from its own start, until all have ended.

    An environment that has ended is frozen: it counts no further.

    Args:
        env: Single environment.
        agent: Batched agent.
        num_episodes: Number of episodes n.
        key: Randomness of starts and actions; the starts depend on nothing else,
            so that agents with the same key meet the same tasks.

    Returns:
        Arrays of shape (n,).
    """
    return record_episodes(env, agent, num_episodes, key, 0)[0]


def record_episodes(
    env: Env, agent: Agent, num_episodes: int, key: PRNGKeyArray, recorded: int
) -> tuple[Episodes, Recording]:
    """As `run_episodes`; the first `recorded` episodes (or all) are kept for pictures.

    Returns:
        Arrays of shape (n,), and the recording.
    """
    return recorder(env, num_episodes, recorded)(agent, key)


def recorder(
    env: Env, num_episodes: int, recorded: int
) -> Callable[[Agent, PRNGKeyArray], tuple[Episodes, Recording]]:
    """`record_episodes` for several agents; compiled once for those of one network."""
    run = jax.jit(partial(_run, env, num_episodes, min(recorded, num_episodes)))
    steps = min(env.episode_length, recording.MAX_STEPS)

    def record(agent: Agent, key: PRNGKeyArray) -> tuple[Episodes, Recording]:
        bound = agent if isinstance(agent, Partial) else Partial(agent)
        results, tape = jax.device_get(run(bound, key))
        lengths = np.minimum(results["length"][:recorded].astype(int), steps)
        return results, Recording(tape, lengths)

    return record


def _run(
    env: Env, num: int, recorded: int, agent: Agent, key: PRNGKeyArray
) -> tuple[dict[str, Any], Any]:
    kinds = env.metric_reductions
    key_reset, key_act = jax.random.split(key)
    first = jax.vmap(env.reset)(jax.random.split(key_reset, num))
    first = cast_like(first, first)
    steps = min(env.episode_length, recording.MAX_STEPS)

    def unfinished(carry):
        _, _, _, done, _, t = carry
        return ~done.all() & (t < env.episode_length)

    def step(carry):
        state, tape, fold, done, lost, t = carry
        action = agent(state.obs, jax.random.fold_in(key_act, t))
        new, finite = finite_step(env, state, action)
        new_fold = episodes.update(fold, new.reward, new.metrics, kinds)
        state = select(done, state, cast_like(new, state))
        fold = select(done, fold, new_fold)
        lost |= ~done & ~finite
        tape = recording.store(tape, state, t + 1)
        return state, tape, fold, done | (state.done > 0.5), lost, t + 1

    nobody = jnp.zeros(num, bool)
    tape = recording.blank(first, recorded, steps)
    fold = episodes.start(kinds, (num,))
    start = (first, tape, fold, nobody, nobody, jnp.int32(0))
    _, tape, fold, _, lost, _ = jax.lax.while_loop(unfinished, step, start)
    return episodes.finish(fold, kinds) | {"lost": lost}, tape


def summarise(results: Episodes, reductions: Mapping[str, str]) -> dict[str, Any]:
    """Statistics of evaluation episodes.

    Rates carry 95 % Clopper-Pearson intervals (`..._rate_ci95`), means bootstrap
    intervals (`..._mean_ci95`).

    Args:
        results: Values of each episode.
        reductions: How the environment's metrics fold: those that sum are events,
            counted by episodes that had any; `success` is a rate; the others are
            summed up by mean, 95th percentile and maximum, those that fold by the
            minimum by mean, 5th percentile and minimum.

    Returns:
        JSON-ready values by name.
    """
    count = len(results["return"])
    steps = int(results["length"].sum())
    summary: dict[str, Any] = {
        "episodes": count,
        "steps": steps,
        "lost_episodes": int(results["lost"].sum()),
    }

    def mean(name: str) -> None:
        summary[f"{name}_mean"], summary[f"{name}_sd"] = mean_sd(results[name])
        summary[f"{name}_mean_ci95"] = list(bootstrap_mean(results[name]))

    def rate(name: str, hits: int) -> None:
        summary[f"{name}_episodes"] = hits
        summary[f"{name}_rate"] = hits / count
        summary[f"{name}_rate_ci95"] = list(clopper_pearson(hits, count))

    mean("return")
    mean("length")
    for name, kind in sorted(reductions.items()):
        values = results[name].astype(np.float64)
        if name == "success":
            rate(name, int((values > 0.5).sum()))
            continue
        mean(name)
        if kind == "sum":
            rate(name, int((values > 0).sum()))
            summary[f"{name}_per_1000_steps"] = 1000.0 * float(values.sum()) / steps
        elif kind == "min":
            summary[f"{name}_p05"] = float(np.percentile(values, 5))
            summary[f"{name}_min"] = float(values.min())
        else:
            summary[f"{name}_p95"] = float(np.percentile(values, 95))
            summary[f"{name}_max"] = float(values.max())
    return summary


def over_seeds(summaries: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Statistics over the evaluations of several training seeds.

    Counts add up; every other number becomes its interquartile mean over the seeds,
    with a 95 % bootstrap interval over the seeds (`..._ci95`) where a single
    evaluation has an interval, and `return_sd` is the deviation between seeds.

    Args:
        summaries: What `summarise` says of each seed.

    Returns:
        JSON-ready values by the same names.
    """
    combined: dict[str, Any] = {}
    for name, first in summaries[0].items():
        values = np.array([summary[name] for summary in summaries])
        if isinstance(first, int):
            combined[name] = int(values.sum())
        elif isinstance(first, float):
            combined[name] = float(interquartile_mean(values))
            if f"{name}_ci95" in summaries[0]:
                interval = bootstrap_mean(values, statistic=interquartile_mean)
                combined[f"{name}_ci95"] = list(interval)
    means = np.array([summary["return_mean"] for summary in summaries])
    return combined | {"seeds": len(summaries), "return_sd": mean_sd(means)[1]}
