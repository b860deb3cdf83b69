"""Evaluation: parallel episodes, one each, and what they say."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Bool, Int, PRNGKeyArray

from rmp_mjx.metric import SUCCESS, Metric, reductions
from rmp_mjx.pytree import Pytree
from rmp_mjx.training.evaluation import recording
from rmp_mjx.training.evaluation.recording import Recording
from rmp_mjx.training.learning import devices, episodes
from rmp_mjx.training.learning.episodes import EpisodeFold
from rmp_mjx.training.learning.networks import Agent
from rmp_mjx.training.learning.rollout import Env, finite_step
from rmp_mjx.training.stats import (
    bootstrap_mean,
    clopper_pearson,
    interquartile_mean,
    mean_sd,
)
from rmp_mjx.trees import cast_like, is_key, select

LANES = 128
"""Episodes that run side by side, at most."""

Episodes = dict[str, np.ndarray]
"""One value per episode: `return`, `length`, `lost` (non-finite), and every metric."""


def run_episodes(
    env: Env, agent: Agent, num_episodes: int, key: PRNGKeyArray
) -> Episodes:
    """Run episodes in parallel, each from its own start, until all have ended.

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


def whole(state: Any, action: Array) -> Any:
    """What a recording keeps of a step unless it is told otherwise: the state."""
    return state


def recorder(
    env: Env,
    num_episodes: int,
    recorded: int,
    keep: Callable[[Any, Array], Any] = whole,
    most: int | None = None,
) -> Callable[[Agent, PRNGKeyArray], tuple[Episodes, Recording]]:
    """`record_episodes` for several agents; compiled once for those of one network.

    Args:
        env: Single environment.
        num_episodes: Number of episodes.
        recorded: How many of them to record.
        keep: What to record of the states (b, ...) and the actions (b, m) that follow
            them; after the last step, an action that is not taken.
        most: Policy steps of an episode to record at most; None: `MAX_STEPS`.
    """
    check_size(env, num_episodes)
    steps = min(env.episode_length, most or recording.MAX_STEPS)
    taped = Taped(min(recorded, num_episodes), steps, keep)
    run = jax.jit(partial(play, env, num_episodes, taped))

    def record(agent: Agent, key: PRNGKeyArray) -> tuple[Episodes, Recording]:
        bound = agent if isinstance(agent, Partial) else Partial(agent)
        results, tape = jax.device_get(run(bound, key))
        lengths = np.minimum(results["length"][:recorded].astype(int), steps)
        return results, Recording(tape, lengths)

    return record


def check_size(env: Env, num_episodes: int) -> None:
    """Refuse more episodes than memory can hold, results before and after a step.

    Args:
        env: Single environment.
        num_episodes: Number of episodes.

    Raises:
        ConfigError: There is less memory.
    """

    def held():
        fold = episodes.start(reductions(env.metrics), (num_episodes,))
        return fold, jax.random.split(jax.random.key(0), num_episodes)

    needed = 2 * devices.size(jax.eval_shape(held))
    devices.check_memory(needed, jax.local_devices(), "the number of episodes")


class Taped(NamedTuple):
    """What of an evaluation is recorded."""

    episodes: int
    """How many, from the first one."""
    steps: int
    """How many policy steps of each."""
    keep: Callable[[Any, Array], Any] = whole
    """What of states and actions."""


class _Lanes(Pytree):
    """Environments that work through the episodes."""

    state: Any
    """Their states."""
    fold: EpisodeFold
    """What their episodes have accumulated."""
    episode: Int[Array, " b"]
    """Which episode each runs."""
    idle: Bool[Array, " b"]
    """Whether it has ended."""
    lost: Bool[Array, " b"]
    """Whether it became non-finite."""


def play(
    env: Env, num: int, taped: Taped, agent: Agent, key: PRNGKeyArray
) -> tuple[dict[str, Any], Any]:
    """Work through episodes in lanes; what `recorder` compiles.

    A lane whose episode has ended takes the next one; it waits until there are enough
    of them for a reset to be worth its time.
    """
    kinds = reductions(env.metrics)
    key_reset, key_act = jax.random.split(key)
    starts = jax.random.split(key_reset, num)
    count = min(num, LANES)
    mesh = devices.local_mesh(count)
    advance = devices.per_device(partial(finite_step, env), mesh, (0, 0), 0)
    keep = taped.keep

    def reset(episode):
        fresh = jax.vmap(env.reset)(starts[jnp.minimum(episode, num - 1)])
        return cast_like(fresh, fresh)

    def refill(lanes, taken):
        episode = jnp.where(lanes.idle, taken + jnp.cumsum(lanes.idle) - 1, num)
        starting = episode < num
        lanes = _Lanes(
            state=select(starting, reset(episode), lanes.state),
            fold=episodes.restart(lanes.fold, starting, kinds),
            episode=jnp.where(starting, episode, lanes.episode),
            idle=lanes.idle & ~starting,
            lost=lanes.lost & ~starting,
        )
        return lanes, taken + starting.sum()

    def unfinished(carry):
        lanes, taken, *_ = carry
        return (taken < num) | ~lanes.idle.all()

    def step(carry):
        lanes, taken, results, tape, t = carry
        enough = (lanes.idle.sum() >= max(1, count // 8)) | lanes.idle.all()
        lanes, taken = jax.lax.cond(
            enough & (taken < num), refill, lambda *same: same, lanes, taken
        )
        action = agent(lanes.state.obs, jax.random.fold_in(key_act, t))
        kept = keep(lanes.state, action)
        tape = recording.store(
            tape, kept, lanes.episode, lanes.fold.length, ~lanes.idle
        )
        new, finite = advance(lanes.state, action)
        fold = episodes.update(lanes.fold, new.reward, new.metrics, kinds)
        ended = (new.done > 0.5) | (fold.length >= env.episode_length)
        lanes = _Lanes(
            state=select(lanes.idle, lanes.state, cast_like(new, lanes.state)),
            fold=select(lanes.idle, lanes.fold, fold),
            episode=lanes.episode,
            idle=lanes.idle | ended,
            lost=lanes.lost | ~(lanes.idle | finite),
        )
        kept = keep(lanes.state, action)
        tape = recording.store(tape, kept, lanes.episode, lanes.fold.length, lanes.idle)
        # Final for those that have ended; the others overwrite it.
        results = jax.tree.map(
            lambda every, own: every.at[lanes.episode].set(own),
            results,
            (lanes.fold, lanes.lost),
        )
        return lanes, taken, results, tape, t + 1

    nobody = jnp.zeros(count, bool)
    blank = jax.tree.map(_zeros, jax.eval_shape(reset, jnp.arange(count)))
    lanes = _Lanes(
        state=blank,
        fold=episodes.start(kinds, (count,)),
        episode=jnp.arange(count),
        idle=~nobody,
        lost=nobody,
    )
    results = episodes.start(kinds, (num,)), jnp.zeros(num, bool)
    kept = jax.eval_shape(keep, blank, jnp.zeros((count, env.action_size)))
    kept = jax.tree.map(_zeros, kept)
    tape = recording.blank(kept, taped.episodes, taped.steps)
    start = (lanes, jnp.int32(0), results, tape, jnp.int32(0))
    _, _, (fold, lost), tape, _ = jax.lax.while_loop(unfinished, step, start)
    return episodes.finish(fold, kinds) | {"lost": lost}, tape


def _zeros(shape: jax.ShapeDtypeStruct) -> Array:
    """Zeros of a shape; keys where it is one of keys."""
    if is_key(shape):
        return jnp.broadcast_to(jax.random.key(0), shape.shape)
    return jnp.zeros(shape.shape, shape.dtype)


def summarise(results: Episodes, metrics: Mapping[str, Metric]) -> dict[str, Any]:
    """Statistics of evaluation episodes.

    Rates carry 95 % Clopper-Pearson intervals (`..._rate_ci95`), means bootstrap
    intervals (`..._mean_ci95`).

    Args:
        results: Values of each episode.
        metrics: The environment's metrics. Each gives its mean, and by its reduction:
            `sum` the share of episodes above 0 and the sum per 1,000 policy steps;
            `min` the 5th percentile and the minimum; the others the 95th percentile
            and the maximum. Of `success` there is the rate alone.

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
    for name, metric in sorted(metrics.items()):
        values, kind = results[name].astype(np.float64), metric.reduction
        if name == SUCCESS.name:
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
