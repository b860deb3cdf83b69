"""Proximal policy optimization (Schulman et al., 2017) as functions of one state.

An iteration has two halves: `gather` lets the policy act, `learn` improves it. All that
training needs to continue is in the `TrainState` between them, so that a restored state
goes on as if it had never been interrupted. Callers jit the halves and vmap them over
seeds (`seeds.programs`). They are two because a simulator that runs as a host callback
keeps its program out of the persistent compile cache: the learner alone is compiled
once per machine.

Neither half depends on the number of devices. Each environment has its own random
stream, and minibatches take equal shares of each of `config.groups` groups of
environments (`update`).
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from brax.training.acme import running_statistics
from brax.training.agents.ppo.networks import PPONetworks
from jax.sharding import Mesh
from jaxtyping import Array, Float, Int, PRNGKeyArray

from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.learning import devices, rollout, value_scale
from rmp_mjx.training.learning.advantages import Metrics, make_batch
from rmp_mjx.training.learning.learner import (
    Learner,
    Optimizers,
    TrainState,
    make_optimizers,
)
from rmp_mjx.training.learning.networks import (
    bounded,
    distribution,
    make_networks,
    sample_action,
)
from rmp_mjx.training.learning.update import Update, in_groups
from rmp_mjx.trees import cast_like

HELD = 10
"""Iterations for which a cloned policy stays as it is."""
MIN_OBS_STD = 1e-3
"""Floor on the deviation of an observation that hardly varies."""


@dataclass(frozen=True)
class PPO:
    """One training problem: an environment and how to learn it."""

    env: rollout.Env
    """Single environment."""
    config: PPOConfig
    """PPO's options."""
    mesh: Mesh
    """Devices that share the environments."""
    networks: PPONetworks
    """Policy, value function and action distribution."""
    optimizers: Optimizers
    """Optimizers of policy and value function."""

    def init(self, key: PRNGKeyArray) -> TrainState:
        """The first state."""
        key, key_policy, key_value, key_env = jax.random.split(key, 4)
        learner = self.optimizers.init(self.networks, key_policy, key_value)
        start = devices.per_device(
            partial(rollout.init, self.env, staggered=True), self.mesh, (0,), 0
        )
        state = TrainState(
            learner=learner,
            normalizer=jax.tree.map(
                jnp.asarray,
                running_statistics.init_state(jnp.zeros(self.env.observation_size)),
            ),
            scale=value_scale.init(),
            rollout=start(jax.random.split(key_env, self.config.num_envs)),
            key=key,
            iteration=jnp.int32(0),
        )
        return cast_like(state, state)

    def gather(
        self, state: TrainState
    ) -> tuple[TrainState, rollout.Transition, rollout.RolloutStats]:
        """Let the policy act for `unroll_length` steps in every environment.

        Returns:
            The state with its environments and key moved on, the transitions (t, b),
            and the statistics over all environments.
        """
        key, key_unroll = jax.random.split(state.key)
        unroll = devices.per_device(self._unroll, self.mesh, (None, 0, 0), (0, 1, 0))
        moved, data, stats = unroll(
            (state.normalizer, state.learner.policy),
            state.rollout,
            jax.random.split(key_unroll, self.config.num_envs),
        )
        return state.replace(rollout=moved, key=key), data, rollout.total(stats)

    def _unroll(self, params, state, keys):
        """Roll out one device's environments; `params`: normalizer and policy."""
        act = partial(sample_action, self.networks, *params)
        return rollout.unroll(self.env, act, state, keys, self.config.unroll_length)

    def learn(
        self, state: TrainState, data: rollout.Transition
    ) -> tuple[TrainState, Metrics]:
        """Learn from what was gathered.

        The first iteration only measures the observations: networks are not updated on
        observations that are not normalized. A policy that was cloned waits for a value
        function that knows it: advantages of another one would ruin it.

        Returns:
            The state with all but its environments moved on, and the learner's metrics.
        """
        key, key_learn = jax.random.split(state.key)
        batch, scale, metrics = make_batch(
            self.config,
            data,
            self.values(state, data.obs),
            self.values(state, data.next_obs),
            state.scale,
        )
        batch = jax.tree.map(partial(in_groups, self.config.groups, self.mesh), batch)
        learner = state.learner.replace(
            value=value_scale.rescale_output(state.learner.value, state.scale, scale)
        )
        update = Update(self.networks, self.optimizers, self.config)
        begun = state.iteration > 0
        held = self.config.demos is not None
        policy_may = state.iteration > HELD if held else True
        learner, learned = update(
            learner, state.normalizer, batch, key_learn, begun, policy_may
        )
        learner = self.annealed(learner, state.iteration + 1)
        std = self.action_std(state.normalizer, learner, data.obs[0, :1])
        normalizer = running_statistics.update(
            state.normalizer, data.obs, weights=data.weight, std_min_value=MIN_OBS_STD
        )
        state = state.replace(
            learner=learner,
            normalizer=normalizer,
            scale=scale,
            key=key,
            iteration=state.iteration + 1,
        )
        return state, metrics | learned | {"action_std": std}

    def annealed(self, learner: Learner, iterations: Int[Array, ""]) -> Learner:
        """The learner with its actions' deviation bounded, see `final_log_std`."""
        first, last = self.config.init_log_std, self.config.final_log_std
        if last is None:
            return learner
        share = iterations * self.config.steps_per_iteration / self.config.anneal_steps
        fallen = jnp.clip(3.0 * share - 2.0, 0.0, 1.0)
        most = jnp.where(fallen > 0.0, first + fallen * (last - first), jnp.inf)
        return learner.replace(policy=bounded(learner.policy, most))

    def iterate(
        self, state: TrainState
    ) -> tuple[TrainState, rollout.RolloutStats, Metrics]:
        """`gather`, then `learn`: a whole iteration in one program."""
        state, data, stats = self.gather(state)
        state, metrics = self.learn(state, data)
        return state, stats, metrics

    def values(
        self, state: TrainState, obs: Float[Array, "*b n"]
    ) -> Float[Array, "*b"]:
        """What the value function expects of observations, in units of the reward."""
        outputs = self.networks.value_network.apply(
            state.normalizer, state.learner.value, obs
        )
        return state.scale.restore(outputs)

    def action_std(
        self, normalizer: Any, learner: Learner, obs: Float[Array, "1 n"]
    ) -> Float[Array, ""]:
        """Mean standard deviation of the actions; no observation changes it."""
        logits = self.networks.policy_network.apply(normalizer, learner.policy, obs)
        return distribution(self.networks, logits).scale.mean()


def make_ppo(env: rollout.Env, config: PPOConfig, mesh: Mesh | None = None) -> PPO:
    """PPO for an environment.

    Args:
        env: Single environment.
        config: PPO's options, validated.
        mesh: Devices that share the environments; None: one device.
    """
    return PPO(
        env=env,
        config=config,
        mesh=mesh or devices.make_mesh(config.groups, 1),
        networks=make_networks(
            env.observation_size,
            env.action_size,
            config.hidden_sizes,
            config.init_log_std,
        ),
        optimizers=make_optimizers(config),
    )
