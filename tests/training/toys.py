"""Toy environments, each isolating one fault of a PPO implementation.

They follow the environment protocol of `rmp_mjx.training.learning.rollout.Env`.
"""

import dataclasses

import jax
import jax.numpy as jnp

from rmp_mjx.metric import SUCCESS, Metric, by_name
from rmp_mjx.pytree import Pytree

METRICS = (
    SUCCESS,
    Metric("collision", "sum", event=True, headline="coll", table=("rate",)),
    Metric("contact_force_peak", "max", "contact peak", "N", table=("max",)),
    Metric("clearance", "min", unit="m", table=("mean", "min")),
    Metric("effort", "mean", table=("mean",)),
    Metric("final", "last", table=("mean",)),
)


@dataclasses.dataclass(frozen=True)
class Options:
    """What a toy can be asked for; only training's records see it."""

    env: str = "counter"
    controller: str = "rmp_vices"
    variant: str = "light"

    @property
    def title(self):
        return f"{self.env}, {self.controller}"

    def record(self):
        return dataclasses.asdict(self)


class ToyState(Pytree):
    """State of a toy environment."""

    data: jax.Array
    obs: jax.Array
    reward: jax.Array
    done: jax.Array
    metrics: dict
    info: dict


@dataclasses.dataclass(frozen=True)
class Toy:
    """Base: subclasses say what an observation, a reward and an end are."""

    observation_size: int = 1
    action_size: int = 1
    dt: float = 0.05
    episode_length: int = 1
    engine: str = "toy"

    @property
    def metrics(self):
        return by_name(METRICS)

    def _state(self, data, obs, reward, done, action=0.0):
        return ToyState(
            data=data,
            obs=obs,
            reward=jnp.float32(reward),
            done=jnp.float32(done),
            metrics={
                "success": jnp.float32(reward > 0.9),
                "collision": jnp.float32(reward < -0.9),
                "contact_force_peak": 100.0 * jnp.float32(reward < -0.9),
                "clearance": 0.1 - jnp.float32(reward < -0.9),
                "effort": jnp.float32(jnp.mean(jnp.abs(action))),
                "final": jnp.float32(reward),
            },
            info={},
        )

    def _draw(self, key):
        del key
        return jnp.zeros(self.observation_size)

    def reset(self, rng):
        data = {"t": jnp.int32(0), "key": rng}
        return self._state(data, self._draw(rng), 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class ConstantReward(Toy):
    """Reward 1, constant observation, terminal after one step: value 1."""

    def step(self, state, action):
        return self._state(state.data, state.obs, 1.0, 1.0, action)


@dataclasses.dataclass(frozen=True)
class ObservedReward(Toy):
    """The reward is the observation (+-1): the value must use it."""

    def _draw(self, key):
        return jax.random.rademacher(key, (1,), dtype=jnp.float32)

    def step(self, state, action):
        return self._state(state.data, state.obs, state.obs[0], 1.0, action)


@dataclasses.dataclass(frozen=True)
class DelayedReward(Toy):
    """Observation 0 then 1; reward 1 at the second step only: discounting."""

    episode_length: int = 10

    def step(self, state, action):
        t = state.data["t"] + 1
        obs = jnp.ones(1)
        last = jnp.float32(t == 2)
        return self._state({**state.data, "t": t}, obs, last, last, action)


@dataclasses.dataclass(frozen=True)
class ActionChoice(Toy):
    """Reward falls with the distance of the action from 0.5."""

    def step(self, state, action):
        reward = 1.0 - jnp.abs(action[0] - 0.5)
        return self._state(state.data, state.obs, reward, 1.0, action)


@dataclasses.dataclass(frozen=True)
class ActionFromObservation(Toy):
    """Reward falls with the distance of the action from half the observation."""

    def _draw(self, key):
        return jax.random.rademacher(key, (1,), dtype=jnp.float32)

    def step(self, state, action):
        reward = 1.0 - jnp.abs(action[0] - 0.5 * state.obs[0])
        return self._state(state.data, state.obs, reward, 1.0, action)


@dataclasses.dataclass(frozen=True)
class EndlessReward(Toy):
    """Reward 1 a step for ever; only the time limit ends it: value 1/(1-gamma)."""

    episode_length: int = 5

    def step(self, state, action):
        t = state.data["t"] + 1
        return self._state({**state.data, "t": t}, state.obs, 1.0, 0.0, action)


@dataclasses.dataclass(frozen=True)
class Counter(Toy):
    """Counts: episodes of a random length that the start draws, reward -1 at the end.

    The observation is (length, step, draw), the draw being unique to a start.
    """

    observation_size: int = 3
    episode_length: int = 6

    def _draw(self, key):
        length = jax.random.randint(key, (), 2, 9).astype(jnp.float32)
        return jnp.stack([length, 0.0, jax.random.uniform(key)])

    def step(self, state, action):
        obs = state.obs.at[1].add(1.0)
        done = jnp.float32(obs[1] >= obs[0])
        return self._state(state.data, obs, -done, done, action)


@dataclasses.dataclass(frozen=True)
class Exploding(Toy):
    """As `ActionChoice`, but a start in four becomes non-finite at its first step."""

    def _draw(self, key):
        return jax.random.bernoulli(key, 0.25, (1,)).astype(jnp.float32)

    def step(self, state, action):
        bad = jnp.where(state.obs[0] > 0.5, jnp.nan, 0.0)
        reward = 1.0 - jnp.abs(action[0] - 0.5) + bad
        return self._state(state.data, state.obs + bad, reward, 1.0, action)


@dataclasses.dataclass(frozen=True)
class Poisoned(Counter):
    """As `Counter`; some starts are bad at their second step.

    Then `poison` is added to observation and reward, or, with `flag`, the environment
    reports itself.
    """

    poison: float = 0.0
    flag: bool = False

    @property
    def metrics(self):
        return by_name([*METRICS, Metric("nonfinite", "max", fault="exploded")])

    def _state(self, data, obs, reward, done, action=0.0):
        bad = (obs[1] == 2.0) & (obs[2] < 0.1)
        poison = jnp.where(bad, self.poison, 0.0)
        state = super()._state(data, obs + poison, reward + poison, done, action)
        said = jnp.float32(bad & self.flag)
        return dataclasses.replace(state, metrics=state.metrics | {"nonfinite": said})
