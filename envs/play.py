"""A policy that plays in its task, episode after episode."""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial
from rich.console import Console

from rmp_mjx import runtime
from rmp_mjx.viewer.player import kept

from . import cli, registry
from .base import ArmEnv
from .eval import agent_of
from .options import Options
from .safety import ENDING
from .spheres import AWAY
from .types import State

BY_HAND = 3
"""Spheres that users can drop into a task, besides its own."""
EVENTS = ("success", *ENDING)
"""What is counted."""


class Moment(NamedTuple):
    """An episode after one of its steps."""

    state: State
    """The environment."""
    episode: int
    """Number of the episode, from 1."""
    reward: float
    """Return so far."""
    events: dict[str, int]
    """Policy steps with each kind of event so far."""
    steps: int
    """Policy steps of all episodes so far."""

    def then(self, state: State) -> Moment:
        """The same episode one policy step later."""
        events = dict(self.events)
        for name in EVENTS:
            if float(state.metrics.get(name, 0.0)):
                events[name] = events.get(name, 0) + 1
        reward = self.reward + float(state.reward)
        return Moment(state, self.episode, reward, events, self.steps + 1)


class Play:
    """One environment and its agent: episodes, one after the other."""

    def __init__(
        self, env: ArmEnv, agent: Callable[[Any, Any], Any], seed: int, by_hand: int
    ):
        """Nothing is compiled before the first step.

        Args:
            env: The task; its last `by_hand` spheres are not there at the start.
            agent: Who acts.
            seed: Of the starts.
            by_hand: Number of spheres that users can drop.
        """
        self.env, self.by_hand = env, by_hand
        self._key = jax.random.key(seed)
        self._reset = jax.jit(env.reset)
        self._go = jax.jit(env.step)
        self._act = jax.jit(_act)
        self.agent = agent
        self.history: collections.deque[Moment] = collections.deque(maxlen=kept(env.dt))
        self.now = self._started(1, 0)
        self._drop({})

    @property
    def agent(self) -> Callable[[Any, Any], Any]:
        """Who acts; another one of the same kind compiles nothing."""
        return self._agent

    @agent.setter
    def agent(self, agent: Callable[[Any, Any], Any]) -> None:
        self._agent = agent if isinstance(agent, Partial) else Partial(agent)

    @property
    def period(self) -> float:
        """Time of a policy step [s]."""
        return self.env.dt

    def begin(self) -> None:
        """A new episode; dropped spheres stay where they are."""
        dropped = self.dropped
        self.now = self._started(self.now.episode + 1, self.now.steps)
        self._drop(dropped)

    def restore(self, frame: Moment) -> None:
        """Go on from a moment; dropped spheres stay where they are."""
        while self.history and self.history[-1].steps > frame.steps:
            self.history.pop()
        dropped, self.now = self.dropped, frame
        self._drop(dropped)

    def _started(self, episode: int, steps: int) -> Moment:
        state = self._reset(jax.random.fold_in(self._key, episode))
        return Moment(state, episode, 0.0, {}, steps)

    def _drop(self, places: dict[int, np.ndarray]) -> None:
        for k in range(self.by_hand):
            self.put(k, places.get(k))

    @property
    def dropped(self) -> dict[int, np.ndarray]:
        """Places of the dropped spheres by their numbers [m]."""
        first, state = self.env.options.obstacles - self.by_hand, self.now.state
        there = np.asarray(state.info["spheres"].placed)[first:]
        places = np.asarray(state.data.mocap_pos)[first:]
        return {int(k): places[k] for k in np.flatnonzero(there)}

    def put(self, k: int, place: Sequence[float] | np.ndarray | None) -> None:
        """Drop sphere k at a place [m]; None: take it away."""
        slot = self.env.options.obstacles - self.by_hand + k
        state, spheres = self.now.state, self.now.state.info["spheres"]
        where = jnp.asarray(AWAY if place is None else place, jnp.float32)
        spheres = spheres.replace(
            placed=spheres.placed.at[slot].set(place is not None),
            velocity=spheres.velocity.at[slot].set(0.0),
        )
        data = state.data
        data = data.replace(mocap_pos=data.mocap_pos.at[slot].set(where))
        state = state.replace(data=data, info=state.info | {"spheres": spheres})
        self.now = self.now._replace(state=state)

    def intent(self, frame: Moment) -> Array:
        """The action that is taken at a moment, (m,)."""
        key = jax.random.fold_in(self._key, frame.steps + 1)
        return self._act(self._agent, frame.state.obs, key)

    def advance(self, action: Array) -> State:
        """Where an action leads from now."""
        return self._go(self.now.state, action)

    def step(self) -> Moment:
        """One policy step; an episode that has ended makes room for the next."""
        before = self.now.state
        over = int(before.info["step"]) >= self.env.episode_length
        if over or float(before.done):
            self.begin()
        self.now = self.now.then(self.advance(self.intent(self.now)))
        self.history.append(self.now)
        return self.now


def _act(agent: Partial, obs: Array, key: Any) -> Array:
    return agent(obs[None], key)[0]


def load(args: Sequence[str]) -> tuple[Play, str]:
    """The task and the policy that flags of `eval.py` name, and a title.

    Raises:
        ValueError: They name none.
    """
    options, config = cli.parse_eval(args)
    runtime.configure()
    env = task_with_room(options.task)
    roomy = dataclasses.replace(options, task=env.options)
    _, agent = agent_of(roomy, config, env, Console())
    title = f"{options.agent}: {options.task.title}"
    return Play(env, agent, options.seed, BY_HAND), title


def task_with_room(options: Options) -> ArmEnv:
    """The task in MuJoCo C, with room for the spheres that users drop."""
    slots = options.obstacles + BY_HAND
    return registry.make(
        dataclasses.replace(options, obstacles=slots, physics="mujoco")
    )
