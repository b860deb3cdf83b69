"""A task as Brax knows environments, for Brax's own wrappers and trainers."""

from __future__ import annotations

import dataclasses

from brax.envs.base import Env
from brax.envs.base import State as BraxState
from jaxtyping import Array, Float

from .base import ArmEnv


class BraxTask(Env):
    """The whole state of a task is Brax's `pipeline_state`.

    Brax's automatic reset restores `pipeline_state` and `obs` only. What a task keeps
    in `info` must be restored too, so it travels in there. Keys are raw
    (`jax.random.PRNGKey`), as Brax's wrappers want them.
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
        start = self.task.reset(rng)
        return BraxState(
            pipeline_state=start,  # pyright: ignore[reportArgumentType]
            obs=start.obs,
            reward=start.reward,
            done=start.done,
            metrics=start.metrics,
            info={},
        )

    def step(self, state: BraxState, action: Float[Array, " m"]) -> BraxState:
        """One policy step."""
        new = self.task.step(state.pipeline_state, action)  # pyright: ignore[reportArgumentType]
        return dataclasses.replace(
            state,
            pipeline_state=new,
            obs=new.obs,
            reward=new.reward,
            done=new.done,
            metrics=state.metrics | new.metrics,
        )
