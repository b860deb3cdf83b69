"""Tasks as Gymnasium environments: one (`TaskEnv`) or many at once (`TaskVector`).

Needs the extra `gym`. Rewards, terminations and observations are those of the task. The
time limit is a truncation. `info` has the task's metrics.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import (
    AutoresetMode,
    VectorEnv,
)
from gymnasium.vector.utils import batch_space
from jaxtyping import Array, Int, Key

from rmp_mjx.trees import cast_like, select

from .base import ArmEnv
from .types import State

LARGEST_SEED = 2**31
"""Upper bound of the drawn seeds."""


def observation_space(task: ArmEnv) -> spaces.Box:
    """All real vectors of the observation's size."""
    return spaces.Box(-np.inf, np.inf, (task.observation_size,), np.float32)


def action_space(task: ArmEnv) -> spaces.Box:
    """[-1, 1] in every entry of an action."""
    return spaces.Box(-1.0, 1.0, (task.action_size,), np.float32)


def _draw(random: np.random.Generator) -> int:
    return int(random.integers(LARGEST_SEED))


def _strong(tree: Any) -> Any:
    """Leaves with strong types: otherwise a step is compiled twice."""
    return cast_like(tree, tree)


class TaskEnv(gymnasium.Env):
    """A single environment."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, task: ArmEnv):
        """Wrap a task made by `envs.load`; compiles at the first reset and step."""
        self.observation_space = observation_space(task)
        self.action_space = action_space(task)
        self._limit = task.episode_length
        self._reset = jax.jit(lambda key: _strong(task.reset(key)))
        self._step = jax.jit(lambda state, action: _strong(task.step(state, action)))
        self._state: State | None = None
        self._age = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode."""
        super().reset(seed=seed, options=options)
        self._state = state = self._reset(jax.random.key(_draw(self.np_random)))
        self._age = 0
        return np.asarray(state.obs), {}

    def step(
        self, action: np.ndarray
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One policy step; entries of the action beyond [-1, 1] are clipped.

        Raises:
            gymnasium.error.ResetNeeded: There is no episode yet.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        clipped = jnp.clip(jnp.asarray(action, jnp.float32), -1.0, 1.0)
        self._state = state = self._step(self._state, clipped)
        self._age += 1
        terminated = bool(state.done > 0.5)
        truncated = not terminated and self._age >= self._limit
        info = {name: float(x) for name, x in jax.device_get(state.metrics).items()}
        return np.asarray(state.obs), float(state.reward), terminated, truncated, info


class _Lanes(NamedTuple):
    """The states of a vector of environments."""

    state: State
    """Their states, batched."""
    age: Int[Array, " b"]
    """Policy steps since their starts."""
    keys: Key[Array, " b"]
    """Keys of their next starts."""


class TaskVector(VectorEnv):
    """Many environments in one compiled program.

    One that ends is reset in the same step (`AutoresetMode.SAME_STEP`): its last
    observation is in `info["final_obs"]`, its metrics are in `info["final_info"]`.
    """

    metadata = {  # noqa: RUF012
        "render_modes": [],
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(self, task: ArmEnv, num_envs: int):
        """Wrap a task made by `envs.load`; compiles at the first reset and step.

        Raises:
            ValueError: `num_envs` is below 1.
        """
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, is {num_envs}")
        self.num_envs = num_envs
        self.single_observation_space = observation_space(task)
        self.single_action_space = action_space(task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._lanes: _Lanes | None = None

        def fresh(keys):
            pairs = jax.vmap(jax.random.split)(keys)
            return _strong(jax.vmap(task.reset)(pairs[:, 0])), pairs[:, 1]

        def start(keys):
            state = _strong(jax.vmap(task.reset)(keys))
            later = jax.vmap(jax.random.fold_in, (0, None))(keys, 1)
            return _Lanes(state, jnp.zeros(num_envs, jnp.int32), later)

        def step(lanes, actions):
            state = jax.vmap(task.step)(lanes.state, jnp.clip(actions, -1.0, 1.0))
            age = lanes.age + 1
            terminated = state.done > 0.5
            truncated = ~terminated & (age >= task.episode_length)
            done = terminated | truncated

            def reset(state, keys):
                new, later = fresh(keys)
                return select(done, (new, later), (state, keys))

            following, keys = jax.lax.cond(
                done.any(), reset, lambda *same: same, _strong(state), lanes.keys
            )
            lanes = _Lanes(following, jnp.where(done, 0, age), keys)
            return lanes, state.obs, state.reward, terminated, truncated, state.metrics

        self._start = jax.jit(start)
        self._step = jax.jit(step, donate_argnums=0)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode everywhere.

        Args:
            seed: Environment k gets seed + k, or the k-th of a list. It then starts
                like a `TaskEnv` with that seed.
            options: Not used.

        Raises:
            ValueError: A list of another length.
        """
        first = seed if isinstance(seed, int) else None
        super().reset(seed=first, options=options)
        each = [None] * self.num_envs if seed is None else seed
        if isinstance(each, int):
            each = range(each, each + self.num_envs)
        if len(each) != self.num_envs:
            raise ValueError(f"{len(each)} seeds for {self.num_envs} environments")
        draws = [
            _draw(self.np_random if one is None else seeding.np_random(one)[0])
            for one in each
        ]
        keys = jax.vmap(jax.random.key)(jnp.asarray(draws, jnp.uint32))
        self._lanes = lanes = self._start(keys)
        return np.array(lanes.state.obs), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One policy step everywhere.

        Raises:
            gymnasium.error.ResetNeeded: There is no episode yet.
        """
        if self._lanes is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        lanes, *outputs = self._step(self._lanes, jnp.asarray(actions))
        self._lanes, obs = lanes, np.array(lanes.state.obs)
        last, reward, terminated, truncated, metrics = jax.device_get(outputs)
        done = terminated | truncated
        info = _masked(metrics, ~done)
        if done.any():
            final = np.full(self.num_envs, None, object)
            for lane in np.flatnonzero(done):
                final[lane] = last[lane]
            info |= {"final_obs": final, "_final_obs": done}
            info |= {"final_info": _masked(metrics, done), "_final_info": done}
        return obs, reward.astype(np.float64), terminated, truncated, info


def _masked(metrics: dict[str, np.ndarray], mask: np.ndarray) -> dict[str, Any]:
    """Metrics as Gymnasium's vectors return info: values and a mask."""
    values = {name: np.where(mask, x, 0.0) for name, x in metrics.items()}
    return values | {f"_{name}": mask for name in metrics}
