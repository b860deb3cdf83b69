"""A batch of environments as one environment of Brax.

Brax's own wrappers return to the first state of each environment when an episode ends,
keep non-finite numbers, and know sums of metrics only. This batch steps by our own
rollout instead: ended episodes start anew, steps that become non-finite are left out,
and the statistics are those of `RolloutStats`. Brax's trainer takes it as it is
(`wrap_env=False`).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from brax.envs.base import Env as BraxEnv
from brax.envs.base import State as BraxState
from jaxtyping import Array, Float, Int, Key, UInt32

from rmp_mjx.pytree import Pytree
from rmp_mjx.training.learning import rollout
from rmp_mjx.training.learning.rollout import RolloutState, RolloutStats


class BatchState(Pytree):
    """Where the environments stand; Brax carries it as its physics' state."""

    rollout: RolloutState
    """Environments and unfinished episodes."""
    keys: Key[Array, " b"]
    """Source of each environment's further starts."""
    stats: RolloutStats
    """Sums since the last report, by environment."""
    unreported: Int[Array, ""]
    """Steps since the last report."""


class Batch(BraxEnv):
    """Many environments side by side, reset anew when they end."""

    def __init__(
        self,
        env: rollout.Env,
        report_every: int,
        report: Callable[[RolloutStats], None],
    ):
        """Wrap an environment.

        Args:
            env: Single environment.
            report_every: Steps between reports.
            report: Called on the host with the sums over all environments since the
                last report; once for every device.
        """
        self._env = env
        self._report_every = report_every
        self._report = report

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return self._env.observation_size

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return self._env.action_size

    @property
    def backend(self) -> str:
        """Whose physics it is."""
        return "the environment's own"

    def reset(self, rng: UInt32[Array, "b 2"]) -> BraxState:
        """Start an episode in each environment, from raw keys, as Brax has them."""
        keys, starts = rollout.split(jax.random.wrap_key_data(rng))
        count = rng.shape[0]
        state = BatchState(
            rollout=rollout.init(self._env, starts, staggered=True),
            keys=keys,
            stats=rollout.init_stats(self._env, count),
            unreported=jnp.int32(0),
        )
        zero = jnp.zeros(count, jnp.float32)
        return _brax_state(state, zero, zero, zero)

    def step(self, state: BraxState, action: Float[Array, "b m"]) -> BraxState:
        """One policy step of all; actions are clipped to [-1, 1]."""
        old: BatchState = state.pipeline_state  # pyright: ignore[reportAssignmentType]
        clipped = jnp.clip(action, -1.0, 1.0)

        def act(obs, keys):
            del obs, keys
            return clipped, {"raw_action": action, "log_prob": state.reward}

        keys, now = rollout.split(old.keys)
        moved, data, stats = rollout.unroll(self._env, act, old.rollout, now, 1)
        data = jax.tree.map(lambda x: x[0], data)
        stats, unreported = self._send(
            jax.tree.map(jnp.add, old.stats, stats), old.unreported + 1
        )
        batch = BatchState(rollout=moved, keys=keys, stats=stats, unreported=unreported)
        done = jnp.maximum(data.termination, data.truncation)
        # Brax's losses leave truncated steps out: right for non-finite ones too.
        left_out = jnp.maximum(data.truncation, 1.0 - data.weight)
        return _brax_state(batch, data.reward, done, left_out)

    def _send(
        self, stats: RolloutStats, unreported: Int[Array, ""]
    ) -> tuple[RolloutStats, Int[Array, ""]]:
        """Report the sums where it is time, and begin anew."""

        def send(stats):
            jax.debug.callback(self._report, rollout.total(stats))
            return jax.tree.map(jnp.zeros_like, stats), jnp.int32(0)

        due = unreported >= self._report_every
        return jax.lax.cond(due, send, lambda same: (same, unreported), stats)


def _brax_state(
    state: BatchState,
    reward: Float[Array, " b"],
    done: Float[Array, " b"],
    truncation: Float[Array, " b"],
) -> BraxState:
    """The state with the entries that Brax's trainer reads."""
    return BraxState(
        pipeline_state=state,  # pyright: ignore[reportArgumentType]
        obs=state.rollout.env_state.obs,
        reward=reward,
        done=done,
        info={"truncation": truncation, "episode_done": done, "episode_metrics": {}},
    )
