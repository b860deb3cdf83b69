"""Batched rollouts: time limit, full resets, exact episode statistics."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from rmp_mjx.training import episodes

VALUE_LIMIT = 1e6
"""Observations or rewards beyond this magnitude count as non-finite."""


class Env(Protocol):
    """A single environment in Brax's convention; callers vmap it."""

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        ...

    @property
    def action_size(self) -> int:
        """Length of an action."""
        ...

    @property
    def dt(self) -> float:
        """Time of a policy step [s]."""
        ...

    @property
    def episode_length(self) -> int:
        """Policy steps after which an episode is cut off."""
        ...

    @property
    def metric_reductions(self) -> Mapping[str, str]:
        """How each per-step metric folds into an episode's value."""
        ...

    def reset(self, rng: PRNGKeyArray) -> Any:
        """A fresh start: a state with obs, reward, done and metrics."""
        ...

    def step(self, state: Any, action: Float[Array, " m"]) -> Any:
        """One policy step; done is 1 where the task itself ends."""
        ...


@struct.dataclass
class RolloutState:
    """Where a batch of environments stands; carried from one unroll to the next."""

    env_state: Any
    """Environment states, batched."""
    fold: episodes.EpisodeFold
    """Unfinished episodes."""
    age: Int[Array, " b"]
    """Policy steps towards the time limit."""


@struct.dataclass
class Transition:
    """One policy step of every environment, (t, b) leading."""

    obs: Float[Array, "*b n"]
    """Observation that the policy saw."""
    next_obs: Float[Array, "*b n"]
    """Observation that followed, before any reset."""
    raw_action: Float[Array, "*b m"]
    """Sampled action before clipping."""
    log_prob: Float[Array, "*b"]
    """Its log density under the acting policy."""
    reward: Float[Array, "*b"]
    """Reward."""
    termination: Float[Array, "*b"]
    """1 where the task ended the episode: no value follows."""
    truncation: Float[Array, "*b"]
    """1 where only the time limit ended it: the next value still counts."""
    weight: Float[Array, "*b"]
    """0 where the simulation became non-finite: the step is left out."""


@struct.dataclass
class RolloutStats:
    """Sums over the steps and the finished episodes of an unroll."""

    episodes: Int[Array, ""]
    """Finished episodes, those lost to a non-finite state not included."""
    episode_sums: dict[str, Float[Array, ""]]
    """Sum over them of `return`, `length` and every metric."""
    step_sums: dict[str, Float[Array, ""]]
    """Sum over all steps of every metric that is a sum (events)."""
    nonfinite: Int[Array, ""]
    """Steps that became non-finite."""


Act = Callable[
    [Float[Array, "b n"], PRNGKeyArray],
    tuple[Float[Array, "b m"], dict[str, Array]],
]


def select(mask: Bool[Array, " b"], new: Any, old: Any) -> Any:
    """Take `new` where the mask holds, `old` elsewhere, leaf by leaf."""

    def pick(n, o):
        return jnp.where(mask.reshape(mask.shape + (1,) * (o.ndim - 1)), n, o)

    return jax.tree.map(pick, new, old)


def cast_like(tree: Any, reference: Any) -> Any:
    """Give every leaf the dtype of its reference, strongly typed: no retracing."""

    def cast(x, ref):
        if jnp.issubdtype(ref.dtype, jax.dtypes.prng_key):
            return x
        return jax.lax.convert_element_type(x, ref.dtype)

    return jax.tree.map(cast, tree, reference)


def finite_step(
    env: Env, env_state: Any, action: Float[Array, "b m"]
) -> tuple[Any, Bool[Array, " b"]]:
    """Step every environment; a non-finite one ends, with reward and metrics 0.

    Returns:
        The new states and a mask of those that are finite. The observation of the
        others is the old one.
    """
    new = jax.vmap(env.step)(env_state, action)
    bounded = (jnp.abs(new.obs) < VALUE_LIMIT).all(-1)  # False for NaN too
    finite = bounded & (jnp.abs(new.reward) < VALUE_LIMIT)
    return new.replace(
        obs=jnp.where(finite[:, None], new.obs, env_state.obs),
        reward=jnp.where(finite, new.reward, 0.0),
        done=jnp.where(finite, new.done, 1.0),
        metrics={
            name: jnp.where(finite & jnp.isfinite(value), value, 0.0)
            for name, value in new.metrics.items()
        },
    ), finite


def init(
    env: Env, num_envs: int, key: PRNGKeyArray, staggered: bool = False
) -> RolloutState:
    """Reset a batch of environments.

    Args:
        env: The environment.
        num_envs: Size of the batch.
        key: Randomness of the starts.
        staggered: Cut the first episodes off at random times, so that a batch of
            transitions shows all phases of an episode rather than one. A cut is a
            truncation: the value beyond it still counts. The statistics of finished
            episodes leave out those that only this cut ended.
    """
    env_state = jax.vmap(env.reset)(jax.random.split(key, num_envs))
    env_state = cast_like(env_state, env_state)
    fold = episodes.start(env.metric_reductions, (num_envs,))
    age = jnp.zeros(num_envs, jnp.int32)
    if staggered:
        key_age = jax.random.fold_in(key, num_envs)
        age = jax.random.randint(key_age, (num_envs,), 0, env.episode_length)
    return RolloutState(env_state=env_state, fold=fold, age=age)


def init_stats(env: Env) -> RolloutStats:
    """Sums before the first step."""
    kinds = env.metric_reductions
    zero = jnp.zeros((), jnp.float32)
    return RolloutStats(
        episodes=jnp.int32(0),
        episode_sums=dict.fromkeys(("return", "length", *kinds), zero),
        step_sums={name: zero for name, kind in kinds.items() if kind == "sum"},
        nonfinite=jnp.int32(0),
    )


def unroll(
    env: Env, act: Act, state: RolloutState, key: PRNGKeyArray, length: int
) -> tuple[RolloutState, Transition, RolloutStats]:
    """Let a policy act for some steps in every environment.

    An environment that ends is reset anew (`env.reset` with a fresh key).

    Args:
        env: The environment.
        act: Batched policy: (observation, key) -> (action, extras), the extras
            with `raw_action` and `log_prob`.
        state: Where the environments stand.
        key: Randomness of actions and resets.
        length: Number of steps T.

    Returns:
        New state, transitions (T, b) and the statistics of the unroll.
    """
    kinds = env.metric_reductions

    def reset_done(done, env_state, key):
        fresh = jax.vmap(env.reset)(jax.random.split(key, done.shape[0]))
        return select(done, cast_like(fresh, env_state), env_state)

    def step(carry, key):
        state, stats = carry
        key_act, key_reset = jax.random.split(key)
        obs = state.env_state.obs
        action, extras = act(obs, key_act)
        new, finite = finite_step(env, state.env_state, action)
        fold = episodes.update(state.fold, new.reward, new.metrics, kinds)
        termination = new.done > 0.5
        age = state.age + 1
        done = termination | (age >= env.episode_length)
        finished = done & finite & (termination | (age == fold.length))
        values = episodes.finish(fold, kinds)
        stats = RolloutStats(
            episodes=stats.episodes + finished.sum(dtype=jnp.int32),
            episode_sums={
                name: total + jnp.where(finished, values[name], 0.0).sum()
                for name, total in stats.episode_sums.items()
            },
            step_sums={
                name: total + new.metrics[name].sum()
                for name, total in stats.step_sums.items()
            },
            nonfinite=stats.nonfinite + (~finite).sum(dtype=jnp.int32),
        )
        transition = Transition(
            obs=obs,
            next_obs=new.obs,
            raw_action=extras["raw_action"],
            log_prob=extras["log_prob"],
            reward=new.reward,
            termination=termination.astype(jnp.float32),
            truncation=(done & ~termination).astype(jnp.float32),
            weight=finite.astype(jnp.float32),
        )
        new = cast_like(new, state.env_state)
        env_state = jax.lax.cond(
            done.any(), reset_done, lambda done, s, key: s, done, new, key_reset
        )
        fold = episodes.restart(fold, done, kinds)
        age = jnp.where(done, 0, age)
        state = RolloutState(env_state=env_state, fold=fold, age=age)
        return (state, stats), transition

    (state, stats), transitions = jax.lax.scan(
        step, (state, init_stats(env)), jax.random.split(key, length)
    )
    return state, transitions, stats
