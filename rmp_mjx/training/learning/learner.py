"""Parameters and optimizer states of policy and value function, and a step of them."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import optax
from brax.training.acme import running_statistics
from brax.training.agents.ppo.networks import PPONetworks
from jaxtyping import Array, Bool, Int, PRNGKeyArray

from rmp_mjx.pytree import Pytree
from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.learning.rollout import RolloutState
from rmp_mjx.training.learning.value_scale import ValueScale

EPSILON = 1e-5
"""Adam's term against division by zero."""


class Learner(Pytree):
    """Networks and optimizers."""

    policy: Any
    """Policy parameters."""
    value: Any
    """Value parameters, in the units of the value scale."""
    policy_opt: optax.OptState
    """Adam's state for the policy."""
    value_opt: optax.OptState
    """Adam's state for the value function."""


@dataclass(frozen=True)
class Optimizers:
    """Adam behind a clip of the gradient's norm, one each."""

    policy: optax.GradientTransformation
    """Of the policy."""
    value: optax.GradientTransformation
    """Of the value function."""

    def init(
        self,
        networks: PPONetworks,
        key_policy: PRNGKeyArray,
        key_value: PRNGKeyArray,
    ) -> Learner:
        """Draw the networks' parameters; the optimizers have seen nothing."""
        policy = networks.policy_network.init(key_policy)
        value = networks.value_network.init(key_value)
        return Learner(
            policy=policy,
            value=value,
            policy_opt=self.policy.init(policy),
            value_opt=self.value.init(value),
        )

    def step(
        self,
        learner: Learner,
        grads: tuple[Any, Any],
        policy_may: Bool[Array, ""],
        value_may: Bool[Array, ""],
    ) -> Learner:
        """Take a gradient step, or stand still.

        Args:
            learner: Before the step.
            grads: Gradients of the policy's and of the value's parameters.
            policy_may: Whether the policy moves; otherwise its parameters and its
                optimizer stay as they are.
            value_may: The same for the value function.
        """
        policy, policy_opt = _step(
            self.policy, grads[0], learner.policy_opt, learner.policy, policy_may
        )
        value, value_opt = _step(
            self.value, grads[1], learner.value_opt, learner.value, value_may
        )
        return Learner(policy, value, policy_opt, value_opt)


def make_optimizers(config: PPOConfig) -> Optimizers:
    """The optimizers of a configuration."""

    def adam(rate: float) -> optax.GradientTransformation:
        return optax.chain(
            optax.clip_by_global_norm(config.max_grad_norm),
            optax.adam(rate, eps=EPSILON),
        )

    return Optimizers(adam(config.learning_rate), adam(config.value_learning_rate))


def _step(
    optimizer: optax.GradientTransformation,
    grad: Any,
    opt: optax.OptState,
    params: Any,
    may: Bool[Array, ""],
) -> tuple[Any, optax.OptState]:
    """New parameters and optimizer state; the old ones where `may` does not hold."""
    updates, new_opt = optimizer.update(grad, opt, params)
    new = optax.apply_updates(params, updates), new_opt
    return jax.tree.map(lambda n, o: jnp.where(may, n, o), new, (params, opt))


class TrainState(Pytree):
    """Everything that training carries from one iteration to the next."""

    learner: Learner
    """Networks and optimizers."""
    normalizer: running_statistics.RunningStatisticsState
    """Observation statistics."""
    scale: ValueScale
    """Scale of the value targets."""
    rollout: RolloutState
    """Environments and unfinished episodes."""
    key: PRNGKeyArray
    """Source of all further randomness."""
    iteration: Int[Array, ""]
    """Finished iterations."""
