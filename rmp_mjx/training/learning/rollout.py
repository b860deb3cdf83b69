"""Batched rollouts: time limit, full resets, exact episode statistics.

Every environment has its own random stream and does not depend on the others. So a
batch may be split over devices without changing any result. One shortcut looks at the
whole batch: a step in which no environment ends computes no reset.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray

from rmp_mjx.metric import Metric, reductions
from rmp_mjx.pytree import Pytree
from rmp_mjx.training.learning import episodes, faults
from rmp_mjx.trees import cast_like, select

VALUE_LIMIT = 1e6
"""Observations or rewards beyond this magnitude count as non-finite."""

NONFINITE = "nonfinite"
"""Metric by which an environment reports that it has become non-finite."""


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
    def metrics(self) -> Mapping[str, Metric]:
        """What a state's metrics are, by name."""
        ...

    def reset(self, rng: PRNGKeyArray) -> Any:
        """A fresh start: a state with obs, reward, done and metrics."""
        ...

    def step(self, state: Any, action: Float[Array, " m"]) -> Any:
        """One policy step; done is 1 where the task itself ends."""
        ...


@runtime_checkable
class Restarts(Protocol):
    """An environment whose episodes in training depend on those before, if it can."""

    def restart(self, rng: PRNGKeyArray, ended: Any) -> Any:
        """A fresh start after an episode's last state; None: the first in training."""
        ...


class RolloutState(Pytree):
    """State of a batch of environments, carried from one unroll to the next."""

    env_state: Any
    """Environment states, batched."""
    fold: episodes.EpisodeFold
    """Unfinished episodes."""
    age: Int[Array, " b"]
    """Policy steps towards the time limit."""
    fault: faults.Fault
    """Steps of the last unroll that became non-finite."""


class Transition(Pytree):
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
    """1 where only the time limit ended it: the next value is bootstrapped."""
    weight: Float[Array, "*b"]
    """0 where the simulation became non-finite: the step is excluded."""


class RolloutStats(Pytree):
    """Sums over the steps and the finished episodes of an unroll, by environment."""

    episodes: Int[Array, "*b"]
    """Finished episodes, except those lost to a non-finite state."""
    episode_sums: dict[str, Float[Array, "*b"]]
    """Sum over them of `return`, `length` and every metric."""
    step_sums: dict[str, Float[Array, "*b"]]
    """Sum over all steps of every metric that is a sum (events)."""
    nonfinite: Int[Array, "*b"]
    """Steps that became non-finite."""

    def add(
        self,
        finished: Bool[Array, "*b"],
        values: Mapping[str, Float[Array, "*b"]],
        metrics: Mapping[str, Float[Array, "*b"]],
        finite: Bool[Array, "*b"],
    ) -> "RolloutStats":
        """Add a step.

        Args:
            finished: Whether it ended an episode that counts.
            values: Values of the episodes so far.
            metrics: Metrics of the step.
            finite: Whether it stayed finite.
        """
        return RolloutStats(
            episodes=self.episodes + finished.astype(jnp.int32),
            episode_sums={
                name: sums + jnp.where(finished, values[name], 0.0)
                for name, sums in self.episode_sums.items()
            },
            step_sums={
                name: sums + metrics[name] for name, sums in self.step_sums.items()
            },
            nonfinite=self.nonfinite + (~finite).astype(jnp.int32),
        )


Act = Callable[
    [Float[Array, "b n"], Key[Array, " b"]],
    tuple[Float[Array, "b m"], dict[str, Array]],
]


def finite_step(
    env: Env, env_state: Any, action: Float[Array, "b m"]
) -> tuple[Any, Bool[Array, " b"]]:
    """Step every environment; a non-finite one ends, with reward and metrics 0.

    An environment may also report it itself, by its metric `nonfinite`.

    Returns:
        The new states and a mask of those that are finite. The observation of the
        others is the old one.
    """
    new = jax.vmap(env.step)(env_state, action)
    bounded = (jnp.abs(new.obs) < VALUE_LIMIT).all(-1)  # False for NaN too
    finite = bounded & (jnp.abs(new.reward) < VALUE_LIMIT)
    if NONFINITE in new.metrics:
        finite &= new.metrics[NONFINITE] < 0.5
    return new.replace(
        obs=jnp.where(finite[:, None], new.obs, env_state.obs),
        reward=jnp.where(finite, new.reward, 0.0),
        done=jnp.where(finite, new.done, 1.0),
        metrics={
            name: jnp.where(finite & jnp.isfinite(value), value, 0.0)
            for name, value in new.metrics.items()
        },
    ), finite


def init(env: Env, keys: Key[Array, " b"], staggered: bool = False) -> RolloutState:
    """Reset a batch of environments.

    Args:
        env: The environment.
        keys: Randomness of each start.
        staggered: Truncate the first episodes at random times, so that a batch of
            transitions has all phases of an episode rather than one. The value after
            a truncation is bootstrapped. The statistics of finished episodes leave
            out those that only this truncation ended.
    """
    keys_start, keys_age = split(keys)
    first = partial(env.restart, ended=None) if isinstance(env, Restarts) else env.reset
    env_state = jax.vmap(first)(keys_start)
    env_state = cast_like(env_state, env_state)
    fold = episodes.start(reductions(env.metrics), keys.shape)
    age = jnp.zeros(keys.shape, jnp.int32)
    if staggered:
        draw = partial(jax.random.randint, shape=(), minval=0)
        age = jax.vmap(partial(draw, maxval=env.episode_length))(keys_age)
    fault = faults.none(env_state, keys.shape[0], env.action_size)
    return RolloutState(env_state=env_state, fold=fold, age=age, fault=fault)


def split(keys: Key[Array, " b"]) -> tuple[Key[Array, " b"], Key[Array, " b"]]:
    """Two random streams for each environment from one."""
    pairs = jax.vmap(jax.random.split)(keys)
    return pairs[:, 0], pairs[:, 1]


def init_stats(env: Env, num_envs: int) -> RolloutStats:
    """Sums before the first step."""
    kinds = reductions(env.metrics)
    zero, none = jnp.zeros(num_envs, jnp.float32), jnp.zeros(num_envs, jnp.int32)
    return RolloutStats(
        episodes=none,
        episode_sums=dict.fromkeys(("return", "length", *kinds), zero),
        step_sums={name: zero for name, kind in kinds.items() if kind == "sum"},
        nonfinite=none,
    )


def total(stats: RolloutStats) -> RolloutStats:
    """The sums over all environments."""
    return jax.tree.map(lambda x: jnp.sum(x, dtype=x.dtype), stats)


@jax.custom_batching.custom_vmap
def _anyone(mask: Bool[Array, " b"]) -> Bool[Array, ""]:
    """Whether a mask holds anywhere, also in any lane of an outer vmap.

    A `cond` on it stays a branch under vmap. With `mask.any()` it would become a
    select, which always computes both sides.
    """
    return mask.any()


@_anyone.def_vmap
def _anyone_vmap(axis_size: int, in_batched: list[bool], mask: Bool[Array, "k b"]):
    del axis_size, in_batched
    return _anyone(mask.reshape(-1)), False


def unroll(
    env: Env, act: Act, state: RolloutState, keys: Key[Array, " b"], length: int
) -> tuple[RolloutState, Transition, RolloutStats]:
    """Let a policy act for some steps in every environment.

    An environment that ends is reset with a new key (`Restarts`: restarted).

    Args:
        env: The environment.
        act: Batched policy: (observations, a key for each) -> (actions, extras), the
            extras with `raw_action` and `log_prob`.
        state: State of the environments.
        keys: Randomness of each environment's actions and resets.
        length: Number of steps T.

    Returns:
        New state, transitions (T, b) and the statistics of the unroll.
    """
    kinds = reductions(env.metrics)

    def reset_done(done, env_state, keys):
        if isinstance(env, Restarts):
            fresh = jax.vmap(env.restart)(keys, env_state)
        else:
            fresh = jax.vmap(env.reset)(keys)
        return select(done, cast_like(fresh, env_state), env_state)

    def note_fault(fault, bad, env_state, action):
        new = faults.Fault(bad, env_state, action)
        return select(bad & ~fault.happened, new, fault)

    def step(carry, t):
        state, stats = carry
        keys_act, keys_reset = split(jax.vmap(jax.random.fold_in, (0, None))(keys, t))
        obs = state.env_state.obs
        action, extras = act(obs, keys_act)
        new, finite = finite_step(env, state.env_state, action)
        fold = episodes.update(state.fold, new.reward, new.metrics, kinds)
        termination = new.done > 0.5
        age = state.age + 1
        done = termination | (age >= env.episode_length)
        finished = done & finite & (termination | (age == fold.length))
        values = episodes.finish(fold, kinds)
        stats = stats.add(finished, values, new.metrics, finite)
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
        fault = jax.lax.cond(
            _anyone(~finite),
            note_fault,
            lambda fault, *_: fault,
            state.fault,
            ~finite,
            state.env_state,
            action,
        )
        new = cast_like(new, state.env_state)
        env_state = jax.lax.cond(
            _anyone(done), reset_done, lambda done, s, keys: s, done, new, keys_reset
        )
        fold = episodes.restart(fold, done, kinds)
        age = jnp.where(done, 0, age)
        state = RolloutState(env_state=env_state, fold=fold, age=age, fault=fault)
        return (state, stats), transition

    clean = jnp.zeros_like(state.fault.happened)
    state = state.replace(fault=state.fault.replace(happened=clean))
    stats = init_stats(env, keys.shape[0])
    (state, stats), transitions = jax.lax.scan(step, (state, stats), jnp.arange(length))
    return state, transitions, stats
