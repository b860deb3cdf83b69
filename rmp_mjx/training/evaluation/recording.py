"""Recorded episodes: the states of a few environments, for pictures."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from rmp_mjx.trees import numbers

MAX_STEPS = 400
"""Policy steps of an episode that are kept for pictures."""


@dataclass(frozen=True)
class Recording:
    """The first episodes of an evaluation."""

    states: Any
    """Environment states, (steps + 1, k) leading, NumPy; keys as their raw data."""
    lengths: Int[np.ndarray, " k"]
    """Steps of each episode, as far as they are kept."""

    @property
    def count(self) -> int:
        """Number of episodes k."""
        return len(self.lengths)

    def first(self, count: int) -> "Recording":
        """The beginnings of the first `count` episodes (or all), for pictures."""
        states = jax.tree.map(lambda x: x[: MAX_STEPS + 1, :count], self.states)
        return Recording(states, np.minimum(self.lengths[:count], MAX_STEPS))

    def state(self, episode: int, step: int) -> Any:
        """The state of one episode after so many steps; its last one beyond its end."""
        step = min(step, int(self.lengths[episode]))
        return jax.tree.map(lambda x: x[step, episode], self.states)


def blank(state: Any, count: int, steps: int) -> Any:
    """An empty tape for `count` episodes of environments with such states (b, ...)."""

    def empty(x: Array) -> Array:
        return jnp.zeros((steps + 1, count, *x.shape[1:]), x.dtype)

    return jax.tree.map(empty, numbers(state))


def store(
    tape: Any,
    state: Any,
    episode: Int[Array, " b"],
    step: Int[Array, " b"],
    wanted: Bool[Array, " b"],
) -> Any:
    """Write states to the tape; states beyond its ends are dropped.

    Args:
        tape: The tape.
        state: States of b environments.
        episode: Their episodes.
        step: How many steps these have taken.
        wanted: Which of them to write.
    """

    def write(row: Array, x: Array) -> Array:
        beyond = jnp.where(wanted, step, row.shape[0])
        return row.at[beyond, episode].set(x, mode="drop")

    return jax.tree.map(write, tape, numbers(state))
