"""An iteration's gradient steps: several passes over a batch, in minibatches.

The rows of a batch lie in groups, (groups, rows, ...). A minibatch takes as many rows
of every group, so that a device that holds whole groups never needs another's data.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import optax
from brax.training.agents.ppo.networks import PPONetworks
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from rmp_mjx.pytree import Pytree
from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.learning import devices
from rmp_mjx.training.learning.advantages import Metrics
from rmp_mjx.training.learning.learner import Learner, Optimizers
from rmp_mjx.training.learning.loss import Batch, ppo_loss

KL_TOLERANCE = 1.5
"""The policy stops beyond this many times the target KL."""


class Progress(Pytree):
    """What an update carries from one minibatch to the next."""

    learner: Learner
    """Networks and optimizers."""
    may_update: Bool[Array, ""]
    """Whether anything moves; False: the losses are only measured."""
    policy_may: Bool[Array, ""]
    """Whether the policy still moves: False once it is too far from the acting one."""


@dataclass(frozen=True)
class Update:
    """How a learner takes its gradient steps."""

    networks: PPONetworks
    """Policy, value function and action distribution."""
    optimizers: Optimizers
    """Their optimizers."""
    config: PPOConfig
    """PPO's options."""

    def minibatch(
        self, normalizer: Any, progress: Progress, batch: Batch
    ) -> tuple[Progress, Metrics]:
        """One gradient step. A non-finite gradient changes nothing and is counted.

        Args:
            normalizer: Observation statistics.
            progress: Before the step.
            batch: Minibatch, (...) leading.

        Returns:
            After the step, and the parts of the loss, the norms of the gradients and
            `skipped_updates`: 1 where a gradient was not finite, with zeros for the
            rest.
        """
        config, learner = self.config, progress.learner
        (_, parts), grads = jax.value_and_grad(ppo_loss, has_aux=True)(
            (learner.policy, learner.value),
            normalizer,
            batch,
            self.networks,
            config.clipping_epsilon,
            config.entropy_cost,
            config.vf_coefficient,
        )
        norms = [optax.tree.norm(grad) for grad in grads]
        usable = jnp.isfinite(norms[0]) & jnp.isfinite(norms[1])
        allowed = usable & progress.may_update
        learner = self.optimizers.step(
            learner, grads, allowed & progress.policy_may, allowed
        )
        parts |= {"policy_grad_norm": norms[0], "value_grad_norm": norms[1]}
        parts = {name: jnp.where(usable, part, 0.0) for name, part in parts.items()}
        parts["skipped_updates"] = 1.0 - usable.astype(jnp.float32)
        return progress.replace(learner=learner), parts

    def epoch(
        self, normalizer: Any, batch: Batch, progress: Progress, key: PRNGKeyArray
    ) -> tuple[Progress, Metrics]:
        """One pass over the batch, (groups, rows) leading, in a random order.

        Returns:
            After the pass, and the means of what its minibatches say. `policy_epochs`
            is 1 where the policy moved. It moves no more after a pass whose mean KL to
            the acting policy is beyond `KL_TOLERANCE` times the target.
        """
        groups, rows = batch.advantage.shape
        order = minibatch_order(key, groups, rows, self.config.num_minibatches)

        def step(progress, index):
            minibatch = jax.tree.map(lambda x: jax.vmap(take)(x, index), batch)
            return self.minibatch(normalizer, progress, minibatch)

        progress, parts = jax.lax.scan(step, progress, order)
        parts = jax.tree.map(jnp.mean, parts)
        parts["policy_epochs"] = progress.policy_may.astype(jnp.float32)
        if self.config.target_kl > 0.0:
            near = parts["kl"] <= KL_TOLERANCE * self.config.target_kl
            progress = progress.replace(policy_may=progress.policy_may & near)
        return progress, parts

    def __call__(
        self,
        learner: Learner,
        normalizer: Any,
        batch: Batch,
        key: PRNGKeyArray,
        may_update: Bool[Array, ""],
        policy_may: Bool[Array, ""] | bool = True,
    ) -> tuple[Learner, Metrics]:
        """All passes over the batch.

        Args:
            learner: Networks and optimizers.
            normalizer: Observation statistics.
            batch: The data, (groups, rows) leading.
            key: Randomness of the orders.
            may_update: Whether anything moves.
            policy_may: Whether the policy moves then.

        Returns:
            The learner, and means over all minibatches; `kl` is that of the last pass,
            `policy_epochs` and `skipped_updates` are counts.
        """
        progress = Progress(learner, may_update, jnp.bool_(policy_may))
        progress, parts = jax.lax.scan(
            lambda progress, key: self.epoch(normalizer, batch, progress, key),
            progress,
            jax.random.split(key, self.config.num_updates_per_batch),
        )
        counted = ("policy_epochs", "skipped_updates")
        metrics = {
            name: part.sum() if name in counted else part.mean()
            for name, part in parts.items()
        }
        metrics["skipped_updates"] *= self.config.num_minibatches
        metrics["kl"] = parts["kl"][-1]
        return progress.learner, metrics


def in_groups(
    groups: int, mesh: Mesh, x: Float[Array, "t b *s"]
) -> Float[Array, "g r *s"]:
    """Rows (t, b) as (group, rows), each group on the device of its environments."""
    t, b, *rest = x.shape
    x = x.reshape(t, groups, b // groups, *rest).swapaxes(0, 1)
    x = x.reshape(groups, -1, *rest)
    return jax.lax.with_sharding_constraint(x, devices.placed(mesh, 0))


def minibatch_order(
    key: PRNGKeyArray, groups: int, rows: int, num_minibatches: int
) -> Int[Array, "k groups m"]:
    """Which rows of each group make each minibatch: every row is in exactly one."""
    keys = jax.random.split(key, groups)
    order = jax.vmap(jax.random.permutation, (0, None))(keys, rows)
    return order.reshape(groups, num_minibatches, -1).swapaxes(0, 1)


def take(x: Float[Array, "n *s"], index: Int[Array, " m"]) -> Float[Array, "m *s"]:
    """Rows of an array."""
    return x[index]
