"""Evaluation: parallel episodes, one each, and what they say."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from rmp_mjx.training import episodes
from rmp_mjx.training.networks import Agent
from rmp_mjx.training.rollout import Env, cast_like, finite_step, select
from rmp_mjx.training.stats import bootstrap_mean, clopper_pearson, mean_sd

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
    return jax.device_get(jax.jit(partial(_run, env, agent, num_episodes))(key))


def _run(env: Env, agent: Agent, num: int, key: PRNGKeyArray) -> dict[str, Any]:
    kinds = env.metric_reductions
    key_reset, key_act = jax.random.split(key)
    first = jax.vmap(env.reset)(jax.random.split(key_reset, num))
    first = cast_like(first, first)

    def unfinished(carry):
        _, _, done, _, t = carry
        return ~done.all() & (t < env.episode_length)

    def step(carry):
        state, fold, done, lost, t = carry
        action = agent(state.obs, jax.random.fold_in(key_act, t))
        new, finite = finite_step(env, state, action)
        new_fold = episodes.update(fold, new.reward, new.metrics, kinds)
        state = select(done, state, cast_like(new, state))
        fold = select(done, fold, new_fold)
        lost |= ~done & ~finite
        return state, fold, done | (state.done > 0.5), lost, t + 1

    nobody = jnp.zeros(num, bool)
    start = (first, episodes.start(kinds, (num,)), nobody, nobody, jnp.int32(0))
    _, fold, _, lost, _ = jax.lax.while_loop(unfinished, step, start)
    return episodes.finish(fold, kinds) | {"lost": lost}


def summarise(results: Episodes, reductions: Mapping[str, str]) -> dict[str, Any]:
    """Statistics of evaluation episodes.

    Rates carry 95 % Clopper-Pearson intervals (`..._rate_ci95`), the mean return a
    bootstrap interval.

    Args:
        results: Values of each episode.
        reductions: How the environment's metrics fold: those that sum are events,
            counted by episodes that had any; `success` is a rate; the others are
            summed up by mean, 95th percentile and maximum.

    Returns:
        JSON-ready values by name.
    """
    returns = results["return"]
    count = len(returns)
    mean, sd = mean_sd(returns)
    summary: dict[str, Any] = {
        "episodes": count,
        "return_mean": mean,
        "return_sd": sd,
        "return_mean_ci95": list(bootstrap_mean(returns)),
        "length_mean": float(results["length"].mean()),
        "steps": int(results["length"].sum()),
        "lost_episodes": int(results["lost"].sum()),
    }

    def rate(name: str, hits: int) -> None:
        summary[f"{name}_rate"] = hits / count
        summary[f"{name}_rate_ci95"] = list(clopper_pearson(hits, count))

    for name, kind in sorted(reductions.items()):
        values = results[name].astype(np.float64)
        if name == "success":
            hits = int((values > 0.5).sum())
            summary["success_episodes"] = hits
            rate(name, hits)
        elif kind == "sum":
            hits = int((values > 0).sum())
            summary[f"{name}_episodes"] = hits
            summary[f"{name}_mean"] = float(values.mean())
            summary[f"{name}_per_1000_steps"] = float(
                1000.0 * values.sum() / results["length"].sum()
            )
            rate(name, hits)
        else:
            summary[f"{name}_mean"] = float(values.mean())
            summary[f"{name}_p95"] = float(np.percentile(values, 95))
            summary[f"{name}_max"] = float(values.max())
    return summary


def record_episode(env: Env, agent: Agent, key: PRNGKeyArray) -> list[Any]:
    """States of one episode, the start included, for rendering."""
    key_reset, key_act = jax.random.split(key)

    @jax.jit
    def step(state, key):
        batch = jax.tree.map(lambda x: x[None], state)
        new, _ = finite_step(env, batch, agent(batch.obs, key))
        return jax.tree.map(lambda x: x[0], cast_like(new, batch))

    state = jax.jit(env.reset)(key_reset)
    states = [state]
    for t in range(env.episode_length):
        state = step(state, jax.random.fold_in(key_act, t))
        states.append(state)
        if state.done > 0.5:
            break
    return states
