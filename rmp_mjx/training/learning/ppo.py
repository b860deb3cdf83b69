"""Proximal policy optimisation as pure functions of one state.

`make_ppo` returns `init(key)`, then an iteration in its two halves, `gather(state)`
and `learn(state, data)`, and whole, `iterate(state)`. All that training needs to go
on is in the `TrainState` between them, so a restored state continues as if it had
never been interrupted. jit and vmap over seeds are the caller's (`seeds.programs`). The
halves exist because a simulator that runs as a host callback keeps its program out of
the persistent compile cache: on its own, the learner is compiled once per machine.

Neither half depends on the number of devices: each environment has its own random
stream, and minibatches take equal shares of each of `config.groups` groups of
environments, so that a device that holds whole groups never needs another's data.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.training.acme import running_statistics
from brax.training.agents.ppo.networks import PPONetworks
from jax.sharding import Mesh
from jaxtyping import Array, Float, Int, PRNGKeyArray

from rmp_mjx.pytree import Pytree
from rmp_mjx.training.config import TrainConfig
from rmp_mjx.training.learning import devices, rollout, value_scale
from rmp_mjx.training.learning.advantages import generalised_advantages
from rmp_mjx.training.learning.loss import Batch, ppo_loss, weighted_mean
from rmp_mjx.training.learning.networks import make_networks
from rmp_mjx.trees import cast_like

MIN_OBS_STD = 1e-3
"""Floor on the deviation of an observation that hardly varies."""


class Learner(Pytree):
    """Networks and optimisers."""

    policy: Any
    """Policy parameters."""
    value: Any
    """Value parameters, in the units of the value scale."""
    policy_opt: optax.OptState
    """Adam's state for the policy."""
    value_opt: optax.OptState
    """Adam's state for the value function."""


class TrainState(Pytree):
    """Everything that training carries from one iteration to the next."""

    learner: Learner
    """Networks and optimisers."""
    normalizer: running_statistics.RunningStatisticsState
    """Observation statistics."""
    scale: value_scale.ValueScale
    """Scale of the value targets."""
    rollout: rollout.RolloutState
    """Environments and unfinished episodes."""
    key: PRNGKeyArray
    """Source of all further randomness."""
    iteration: Int[Array, ""]
    """Finished iterations."""


Metrics = dict[str, Float[Array, ""]]


def take(x: Float[Array, "n *s"], index: Int[Array, " m"]) -> Float[Array, "m *s"]:
    """Rows of an array."""
    return x[index]


class PPO(NamedTuple):
    """The functions of one training problem."""

    networks: PPONetworks
    """Policy, value function and action distribution."""
    init: Callable[[PRNGKeyArray], TrainState]
    """First state."""
    gather: Callable[
        [TrainState], tuple[TrainState, rollout.Transition, rollout.RolloutStats]
    ]
    """Let the policy act; moves the environments and the key."""
    learn: Callable[[TrainState, rollout.Transition], tuple[TrainState, Metrics]]
    """Learn from what was gathered; moves the rest."""
    iterate: Callable[[TrainState], tuple[TrainState, rollout.RolloutStats, Metrics]]
    """Both, one after the other."""


def make_ppo(env: rollout.Env, config: TrainConfig, mesh: Mesh | None = None) -> PPO:
    """Build PPO for an environment.

    The first iteration only gathers the observation statistics: networks are not
    updated on unnormalised observations.

    Args:
        env: Single environment.
        config: Validated configuration.
        mesh: Devices that share the environments; one by default.

    Returns:
        The networks and the functions.
    """
    mesh = mesh or devices.make_mesh(config.groups, 1)
    networks = make_networks(
        env.observation_size,
        env.action_size,
        config.hidden_sizes,
        config.init_log_std,
    )
    distribution = networks.parametric_action_distribution
    optimizers = tuple(
        optax.chain(
            optax.clip_by_global_norm(config.max_grad_norm), optax.adam(rate, eps=1e-5)
        )
        for rate in (config.learning_rate, config.value_learning_rate)
    )

    start = devices.per_device(
        partial(rollout.init, env, staggered=True), mesh, (0,), 0
    )

    def init(key: PRNGKeyArray) -> TrainState:
        key, key_policy, key_value, key_env = jax.random.split(key, 4)
        policy = networks.policy_network.init(key_policy)
        value = networks.value_network.init(key_value)
        state = TrainState(
            learner=Learner(
                policy=policy,
                value=value,
                policy_opt=optimizers[0].init(policy),
                value_opt=optimizers[1].init(value),
            ),
            normalizer=jax.tree.map(
                jnp.asarray,
                running_statistics.init_state(jnp.zeros(env.observation_size)),
            ),
            scale=value_scale.init(),
            rollout=start(jax.random.split(key_env, config.num_envs)),
            key=key,
            iteration=jnp.int32(0),
        )
        return cast_like(state, state)

    def minibatch_step(normalizer, carry, batch):
        learner, may_update, policy_may = carry
        (_, parts), grads = jax.value_and_grad(ppo_loss, has_aux=True)(
            (learner.policy, learner.value),
            normalizer,
            batch,
            networks,
            config.clipping_epsilon,
            config.entropy_cost,
            config.vf_coefficient,
        )
        norms = [optax.tree.norm(grad) for grad in grads]
        usable = jnp.isfinite(norms[0]) & jnp.isfinite(norms[1])

        def apply(optimizer, grad, opt, params, allowed):
            updates, new_opt = optimizer.update(grad, opt, params)
            new = optax.apply_updates(params, updates), new_opt
            return jax.tree.map(
                lambda n, o: jnp.where(allowed, n, o), new, (params, opt)
            )

        allowed = usable & may_update
        policy, policy_opt = apply(
            optimizers[0],
            grads[0],
            learner.policy_opt,
            learner.policy,
            allowed & policy_may,
        )
        value, value_opt = apply(
            optimizers[1], grads[1], learner.value_opt, learner.value, allowed
        )
        parts |= {"policy_grad_norm": norms[0], "value_grad_norm": norms[1]}
        parts = {name: jnp.where(usable, part, 0.0) for name, part in parts.items()}
        parts["skipped_updates"] = 1.0 - usable.astype(jnp.float32)
        learner = Learner(policy, value, policy_opt, value_opt)
        return (learner, may_update, policy_may), parts

    def grouped(x):
        """(t, b, ...) to (group, rows, ...), each group where its environments are."""
        t, b, *rest = x.shape
        x = x.reshape(t, config.groups, b // config.groups, *rest).swapaxes(0, 1)
        x = x.reshape(config.groups, -1, *rest)
        return jax.lax.with_sharding_constraint(x, devices.placed(mesh, 0))

    def update(learner, normalizer, batch: Batch, key, may_update):
        groups, rows = batch.advantage.shape

        def epoch(carry, key):
            keys = jax.random.split(key, groups)
            order = jax.vmap(jax.random.permutation, (0, None))(keys, rows)
            order = order.reshape(groups, config.num_minibatches, -1).swapaxes(0, 1)
            carry, parts = jax.lax.scan(
                lambda c, i: minibatch_step(
                    normalizer, c, jax.tree.map(lambda x: jax.vmap(take)(x, i), batch)
                ),
                carry,
                order,
            )
            learner, may_update, policy_may = carry
            parts = jax.tree.map(jnp.mean, parts)
            parts["policy_epochs"] = policy_may.astype(jnp.float32)
            if config.target_kl > 0.0:
                policy_may &= parts["kl"] <= 1.5 * config.target_kl
            return (learner, may_update, policy_may), parts

        (learner, _, _), parts = jax.lax.scan(
            epoch,
            (learner, may_update, jnp.bool_(True)),
            jax.random.split(key, config.num_updates_per_batch),
        )
        counted = ("policy_epochs", "skipped_updates")
        metrics = {
            name: part.sum() if name in counted else part.mean()
            for name, part in parts.items()
        }
        metrics["skipped_updates"] *= config.num_minibatches
        metrics["kl"] = parts["kl"][-1]
        return learner, metrics

    def unroll(params, state, keys):
        def act(obs, keys):
            logits = networks.policy_network.apply(*params, obs)
            raw = jax.vmap(distribution.sample_no_postprocessing)(logits, keys)
            extras = {
                "raw_action": raw,
                "log_prob": distribution.log_prob(logits, raw),
            }
            return jnp.clip(raw, -1.0, 1.0), extras

        return rollout.unroll(env, act, state, keys, config.unroll_length)

    unroll = devices.per_device(unroll, mesh, (None, 0, 0), (0, 1, 0))

    def gather(state: TrainState):
        key, key_unroll = jax.random.split(state.key)
        roll, data, stats = unroll(
            (state.normalizer, state.learner.policy),
            state.rollout,
            jax.random.split(key_unroll, config.num_envs),
        )
        return state.replace(rollout=roll, key=key), data, rollout.total(stats)

    def learn(state: TrainState, data: rollout.Transition):
        key, key_learn = jax.random.split(state.key)
        learner, normalizer = state.learner, state.normalizer

        def value(obs):
            outputs = networks.value_network.apply(normalizer, learner.value, obs)
            return state.scale.restore(outputs)

        values = value(data.obs)
        advantages = generalised_advantages(
            data,
            values,
            value(data.next_obs),
            config.discounting,
            config.gae_lambda,
        )
        targets = values + advantages
        mean = weighted_mean(advantages, data.weight)
        variance = weighted_mean((advantages - mean) ** 2, data.weight)
        scale = value_scale.update(state.scale, targets, data.weight)
        learner = learner.replace(
            value=value_scale.rescale_output(learner.value, state.scale, scale)
        )
        batch = Batch(
            obs=data.obs,
            raw_action=data.raw_action,
            log_prob=data.log_prob,
            advantage=(advantages - mean) / (jnp.sqrt(variance) + 1e-8),
            target=scale.normalise(targets),
            weight=data.weight,
        )
        batch = jax.tree.map(grouped, batch)
        learner, metrics = update(
            learner, normalizer, batch, key_learn, state.iteration > 0
        )
        spread = weighted_mean(
            (targets - weighted_mean(targets, data.weight)) ** 2, data.weight
        )
        metrics |= {
            "explained_variance": 1.0
            - weighted_mean(advantages**2, data.weight) / (spread + 1e-8),
            "value_mean": weighted_mean(values, data.weight),
            "value_scale": scale.std,
            "action_std": distribution.create_dist(
                networks.policy_network.apply(
                    normalizer, learner.policy, data.obs[0, :1]
                )
            ).scale.mean(),
        }
        normalizer = running_statistics.update(
            normalizer, data.obs, weights=data.weight, std_min_value=MIN_OBS_STD
        )
        state = TrainState(
            learner=learner,
            normalizer=normalizer,
            scale=scale,
            rollout=state.rollout,
            key=key,
            iteration=state.iteration + 1,
        )
        return state, metrics

    def iterate(state: TrainState):
        state, data, stats = gather(state)
        state, metrics = learn(state, data)
        return state, stats, metrics

    return PPO(networks, init, gather, learn, iterate)
