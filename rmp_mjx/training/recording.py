"""Recorded episodes: the states of a few environments, for pictures."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

MAX_STEPS = 400
"""Policy steps of an episode that are kept."""


@dataclass(frozen=True)
class Recording:
    """The first episodes of an evaluation."""

    states: Any
    """Environment states, (steps + 1, k) leading, NumPy; keys as their raw data. An
    episode that has ended stays in its last state."""
    lengths: Int[np.ndarray, " k"]
    """Steps of each episode, `MAX_STEPS` at most."""

    @property
    def count(self) -> int:
        """Number of episodes k."""
        return len(self.lengths)

    def state(self, episode: int, step: int) -> Any:
        """The state of one episode after so many steps; its last one beyond its end."""
        step = min(step, int(self.lengths[episode]))
        return jax.tree.map(lambda x: x[step, episode], self.states)


def blank(state: Any, count: int, steps: int) -> Any:
    """A tape for the first `count` environments, filled with the given states."""

    def repeat(x: Array) -> Array:
        return jnp.broadcast_to(x[:count], (steps + 1, *x[:count].shape))

    return jax.tree.map(repeat, _arrays(state))


def store(tape: Any, state: Any, step: Int[Array, ""]) -> Any:
    """Write a step's states onto the tape; steps beyond its end are dropped."""

    def write(row: Array, x: Array) -> Array:
        return row.at[step].set(x[: row.shape[1]], mode="drop")

    return jax.tree.map(write, tape, _arrays(state))


def _arrays(state: Any) -> Any:
    """The states with random keys as plain numbers."""

    def plain(x: Array) -> Array:
        is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        return jax.random.key_data(x) if is_key else x

    return jax.tree.map(plain, state)
