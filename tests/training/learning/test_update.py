"""Gradient steps one by one: order, groups, non-finite gradients, the stop by KL."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics

from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.learning import devices
from rmp_mjx.training.learning.learner import make_optimizers
from rmp_mjx.training.learning.loss import Batch
from rmp_mjx.training.learning.networks import make_networks
from rmp_mjx.training.learning.update import (
    Progress,
    Update,
    in_groups,
    minibatch_order,
    take,
)
from tests.training.conftest import bits

OBS, ACTION = 3, 2
GROUPS, ROWS = 2, 8
CONFIG = PPOConfig(
    num_minibatches=4, num_updates_per_batch=3, hidden_sizes=(4,), target_kl=0.0
)
NORMALIZER = functools.partial(running_statistics.init_state, np.zeros(OBS))


@pytest.fixture
def update():
    """`update(**changes)`: the gradient steps of a configuration."""
    networks = make_networks(OBS, ACTION, CONFIG.hidden_sizes, CONFIG.init_log_std)

    def make(**changes):
        config = dataclasses.replace(CONFIG, **changes)
        return Update(networks, make_optimizers(config), config)

    return make


@pytest.fixture
def learner(update):
    own = update()
    return own.optimizers.init(own.networks, jax.random.key(1), jax.random.key(2))


@pytest.fixture
def batch():
    """Transitions of a policy close to the first one, (GROUPS, ROWS)."""
    keys = jax.random.split(jax.random.key(0), 5)
    shape = (GROUPS, ROWS)
    return Batch(
        obs=jax.random.normal(keys[0], (*shape, OBS)),
        raw_action=jax.random.normal(keys[1], (*shape, ACTION)),
        log_prob=-2.0 + 0.1 * jax.random.normal(keys[2], shape),
        advantage=jax.random.normal(keys[3], shape),
        target=jax.random.normal(keys[4], shape),
        weight=jnp.ones(shape),
    )


def same(one, two):
    return jax.tree.map(bits, one) == jax.tree.map(bits, two)


def whole(update, learner, batch, may_update=True):
    key, allowed = jax.random.key(3), jnp.bool_(may_update)
    return jax.jit(update.__call__)(learner, NORMALIZER(), batch, key, allowed)


def test_a_group_has_the_rows_of_its_own_environments():
    t, b, groups = 3, 8, 4
    lane = jnp.broadcast_to(jnp.arange(b), (t, b))
    found = in_groups(groups, devices.make_mesh(groups, 1), lane)
    assert found.shape == (groups, t * b // groups)
    for group, lanes in enumerate(np.asarray(found)):
        assert sorted(lanes) == sorted([2 * group, 2 * group + 1] * t)


def test_minibatches_are_a_partition_with_as_many_rows_of_each_group():
    order = np.asarray(minibatch_order(jax.random.key(0), GROUPS, ROWS, 4))
    assert order.shape == (4, GROUPS, ROWS // 4)
    for group in range(GROUPS):
        assert sorted(order[:, group].ravel()) == list(range(ROWS))
    assert not np.array_equal(order[:, 0], order[:, 1])
    other = minibatch_order(jax.random.key(1), GROUPS, ROWS, 4)
    assert not np.array_equal(order, other)


def test_rows_are_taken_within_their_group():
    x = 100 * np.arange(GROUPS)[:, None] + np.arange(ROWS)
    order = minibatch_order(jax.random.key(0), GROUPS, ROWS, 4)
    found = np.stack([jax.vmap(take)(jnp.asarray(x), index) for index in order])
    assert (found // 100 == np.arange(GROUPS)[:, None]).all()
    assert sorted(found.ravel()) == sorted(x.ravel())


def test_a_step_lowers_the_loss_of_its_minibatch(update, learner, batch):
    yes = jnp.bool_(True)
    progress = Progress(learner, yes, yes)
    step = jax.jit(functools.partial(update().minibatch, NORMALIZER()))
    losses = []
    for _ in range(20):
        progress, parts = step(progress, batch)
        losses.append(float(parts["policy_loss"] + parts["value_loss"]))
    assert losses[-1] < losses[0]
    assert not same(progress.learner.policy, learner.policy)


def test_a_nonfinite_gradient_changes_nothing_and_is_counted(update, learner, batch):
    yes = jnp.bool_(True)
    broken = batch.replace(target=batch.target.at[0, 0].set(jnp.nan))
    step = jax.jit(functools.partial(update().minibatch, NORMALIZER()))
    progress, parts = step(Progress(learner, yes, yes), broken)
    assert same(progress.learner, learner)
    assert parts.pop("skipped_updates") == 1.0
    assert set(map(float, parts.values())) == {0.0}
    _, parts = step(Progress(learner, yes, yes), batch)
    assert parts["skipped_updates"] == 0.0


def test_one_bad_row_costs_one_minibatch_of_every_epoch(update, learner, batch):
    broken = batch.replace(advantage=batch.advantage.at[1, 5].set(jnp.inf))
    new, metrics = whole(update(), learner, broken)
    assert metrics["skipped_updates"] == CONFIG.num_updates_per_batch
    assert not same(new.value, learner.value)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((new, metrics)))


@pytest.mark.parametrize(("target_kl", "stops"), [(1e-9, True), (1e9, False)])
def test_beyond_the_target_kl_the_policy_stands_still_and_the_value_goes_on(
    update, learner, batch, target_kl, stops
):
    yes = jnp.bool_(True)
    epoch = functools.partial(update(target_kl=target_kl).epoch, NORMALIZER(), batch)
    epoch = jax.jit(epoch)
    first, said = epoch(Progress(learner, yes, yes), jax.random.key(3))
    assert said["policy_epochs"] == 1.0 and said["kl"] > 1e-6
    assert bool(first.policy_may) is not stops
    second, said = epoch(first, jax.random.key(4))
    assert said["policy_epochs"] == 1.0 - stops
    frozen = (second.learner.policy, second.learner.policy_opt)
    assert same(frozen, (first.learner.policy, first.learner.policy_opt)) is stops
    assert not same(second.learner.value, first.learner.value)


def test_a_pass_that_may_not_update_measures_all_the_same(update, learner, batch):
    new, metrics = whole(update(), learner, batch, may_update=False)
    assert same(new, learner)
    assert metrics["value_loss"] > 0.0 and metrics["value_grad_norm"] > 0.0
    assert metrics["skipped_updates"] == 0.0
