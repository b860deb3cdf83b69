"""A task as Brax knows environments, for Brax's own wrappers and trainers."""

from __future__ import annotations

from typing import Any

from brax.envs.base import Env
from brax.envs.base import State as BraxState
from jaxtyping import Array, Float

from envs.base import ArmEnv
from envs.types import State


class BraxTask(Env):
    """All of a task's state takes the place of the physics' state.

    Brax's automatic reset brings back `pipeline_state` and `obs` alone, so what the
    task carries along must be in there; `info` is left to the wrappers, which also add
    to the metrics. Keys are raw (`jax.random.PRNGKey`), as Brax's wrappers want them.
    """

    def __init__(self, task: ArmEnv):
        """Wrap a task made by `envs.load`."""
        self.task = task

    @property
    def observation_size(self) -> int:
        """Numbers in an observation."""
        return self.task.observation_size

    @property
    def action_size(self) -> int:
        """Numbers in an action."""
        return self.task.action_size

    @property
    def backend(self) -> str:
        """Name of the physics."""
        return self.task.options.physics

    def reset(self, rng: Array) -> BraxState:
        """Start an episode."""
        return _state(self.task.reset(rng), {}, {})

    def step(self, state: BraxState, action: Float[Array, " 12"]) -> BraxState:
        """One policy step."""
        new = self.task.step(state.pipeline_state, action)  # pyright: ignore[reportArgumentType]
        return _state(new, state.metrics, state.info)


def _state(state: State, metrics: dict[str, Array], info: dict[str, Any]) -> BraxState:
    return BraxState(
        pipeline_state=state,  # pyright: ignore[reportArgumentType]
        obs=state.obs,
        reward=state.reward,
        done=state.done,
        metrics=metrics | state.metrics,
        info=info,
    )
