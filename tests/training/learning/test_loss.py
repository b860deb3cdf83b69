"""Our loss against Brax's on the same data."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training import types
from brax.training.acme import running_statistics
from brax.training.agents.ppo import losses
from scipy import stats

from rmp_mjx.training.learning import value_scale
from rmp_mjx.training.learning.advantages import generalised_advantages
from rmp_mjx.training.learning.loss import (
    Batch,
    explained_variance,
    ppo_loss,
    standardized,
    weighted_mean,
)
from rmp_mjx.training.learning.networks import distribution, make_networks
from rmp_mjx.training.learning.rollout import Transition

T, B, OBS, ACT = 4, 6, 3, 2


@pytest.fixture(scope="module")
def problem():
    networks = make_networks(OBS, ACT, (8,), -0.5)
    keys = jax.random.split(jax.random.key(0), 8)
    obs = jax.random.normal(keys[0], (T + 1, B, OBS))
    normalizer = running_statistics.init_state(jnp.zeros(OBS))
    params = (
        networks.policy_network.init(keys[1]),
        networks.value_network.init(keys[2]),
    )
    raw = jax.random.normal(keys[3], (T, B, ACT))
    old = networks.policy_network.apply(
        normalizer, networks.policy_network.init(keys[4]), obs[:-1]
    )
    data = Transition(
        obs=obs[:-1],
        next_obs=obs[1:],
        raw_action=raw,
        log_prob=networks.parametric_action_distribution.log_prob(old, raw),
        reward=jax.random.normal(keys[5], (T, B)),
        termination=jnp.zeros((T, B)).at[1, 2].set(1.0),
        truncation=jnp.zeros((T, B)),
        weight=jnp.ones((T, B)),
    )
    return networks, normalizer, params, data, old


def ours(params, problem, data):
    networks, normalizer, start, _, _ = problem
    values, following = (
        networks.value_network.apply(normalizer, start[1], obs)
        for obs in (data.obs, data.next_obs)
    )
    advantage = generalised_advantages(data, values, following, 0.9, 1.0)
    batch = Batch(
        obs=data.obs,
        raw_action=data.raw_action,
        log_prob=data.log_prob,
        advantage=(advantage - advantage.mean()) / (advantage.std() + 1e-8),
        target=values + advantage,
        weight=data.weight,
    )
    batch = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)
    return ppo_loss(params, normalizer, batch, networks, 0.2, 0.01, 0.7)


def test_loss_and_gradient_are_those_of_brax(problem):
    networks, normalizer, params, data, old = problem

    def brax(params):
        extras: Any = {
            "state_extras": {"truncation": data.truncation},
            "policy_extras": {
                "raw_action": data.raw_action,
                "log_prob": data.log_prob,
                "distribution_params": old,
            },
        }
        swapped = types.Transition(
            observation=data.obs,
            action=data.raw_action,
            reward=data.reward,
            discount=1.0 - data.termination,
            next_observation=data.next_obs,
            extras=extras,
        )
        swapped = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), swapped)
        return losses.compute_ppo_loss(
            losses.PPONetworkParams(*params),
            normalizer,
            swapped,
            jax.random.key(0),
            networks,
            entropy_cost=0.01,
            discounting=0.9,
            gae_lambda=1.0,  # Brax weighs its policy advantage otherwise below 1
            clipping_epsilon=0.2,
            vf_coefficient=0.7,
        )[0]

    both = jax.jit(
        lambda p: (
            jax.value_and_grad(lambda p: ours(p, problem, data)[0])(p),
            jax.value_and_grad(brax)(p),
        )
    )
    (value, grad), (brax_value, brax_grad) = both(params)
    # float32 sums over 24 transitions in another order
    np.testing.assert_allclose(value, brax_value, rtol=1e-5)
    for a, b in zip(jax.tree.leaves(grad), jax.tree.leaves(brax_grad), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def test_the_kl_is_that_of_two_gaussians_from_the_acting_policy_to_the_new(problem):
    """By their formula, within five standard errors of 20,000 actions.

    Of another sign, or from the new policy to the acting one, it is 50 errors away.
    """
    networks, normalizer, params, _, _ = problem
    rng, size = np.random.default_rng(0), 20_000
    obs = jnp.ones((size, OBS))
    logits = networks.policy_network.apply(normalizer, params[0], obs[:1])
    new = distribution(networks, logits)
    mean, scale = np.asarray(new.loc, float), np.asarray(new.scale, float)
    old_mean, old_scale = mean + 0.5 * scale, 1.3 * scale
    raw = old_mean + old_scale * rng.normal(size=(size, ACT))
    old, now = (
        stats.norm.logpdf(raw, *of).sum(1)
        for of in ((old_mean, old_scale), (mean, scale))
    )
    batch = Batch(
        obs=obs,
        raw_action=jnp.asarray(raw, jnp.float32),
        log_prob=jnp.asarray(old, jnp.float32),
        advantage=jnp.zeros(size),
        target=jnp.zeros(size),
        weight=jnp.ones(size),
    )
    _, parts = ppo_loss(params, normalizer, batch, networks, 0.2, 0.1, 1.0)
    exact = ACT * (-np.log(1.3) + (1.3**2 + 0.5**2) / 2.0 - 0.5)
    error = np.std(np.expm1(now - old) - (now - old)) / np.sqrt(size)
    assert abs(parts["kl"] - exact) < 5.0 * error < 0.1 * exact
    outside = np.abs(np.expm1(now - old)) > 0.2
    # float32: some of the 20,000 may be on the other side of the bound
    assert abs(parts["clip_fraction"] - outside.mean()) < 1e-3
    entropy = ACT * (0.5 + 0.5 * np.log(2.0 * np.pi)) + np.log(scale).sum()
    np.testing.assert_allclose(parts["entropy"], entropy, rtol=1e-5)  # float32


def test_a_transition_of_weight_zero_has_no_influence(problem):
    networks, normalizer, params, _, _ = problem
    size = 6
    batch = Batch(
        obs=jnp.arange(size * OBS).reshape(size, OBS) / 10.0,
        raw_action=jnp.ones((size, ACT)) / 3.0,
        log_prob=-jnp.ones(size),
        advantage=jnp.linspace(-1.0, 1.0, size),
        target=jnp.linspace(0.0, 1.0, size),
        weight=jnp.array([1.0, 1.0, 1.0, 1.0, 0.0, 0.0]),
    )
    kept = jax.tree.map(lambda x: x[:4], batch)
    for one, two in zip(
        jax.tree.leaves(ppo_loss(params, normalizer, batch, networks, 0.2, 0.1, 1.0)),
        jax.tree.leaves(ppo_loss(params, normalizer, kept, networks, 0.2, 0.1, 1.0)),
        strict=True,
    ):
        np.testing.assert_allclose(one, two, rtol=1e-6)  # float32, sums with zeros


def test_the_first_update_takes_the_moments_of_the_targets():
    targets = jnp.array([1.0, 3.0, 100.0, 5.0])
    weight = jnp.array([1.0, 1.0, 0.0, 1.0])
    scale = value_scale.update(value_scale.init(), targets, weight)
    np.testing.assert_allclose(scale.mean, 3.0, rtol=1e-6)  # float32
    np.testing.assert_allclose(scale.std, np.std([1, 3, 5]), rtol=1e-6)


def test_the_moments_follow_returns_that_grow():
    scale = value_scale.init()
    for k in range(200):
        targets = 100.0 * k + jnp.linspace(-1.0, 1.0, 50)
        scale = value_scale.update(scale, targets, jnp.ones(50))
    # an average over the last 1 / 0.05 = 20 updates lags by 19 of them
    np.testing.assert_allclose(scale.mean, 19900 - 1900, rtol=1e-3)


def test_rescaling_keeps_every_value():
    networks = make_networks(3, 2, (8, 8), -0.5)
    params = networks.value_network.init(jax.random.key(0))
    obs = jax.random.normal(jax.random.key(1), (16, 3))
    old = value_scale.ValueScale(jnp.float32(2.0), jnp.float32(9.0), jnp.float32(0.5))
    new = value_scale.ValueScale(jnp.float32(700.0), jnp.float32(4e4), jnp.float32(0.5))
    moved = value_scale.rescale_output(params, old, new)

    def value(params, scale):
        # constant statistics: the preprocessing is not what is tested
        from brax.training.acme import running_statistics

        statistics = running_statistics.init_state(jnp.zeros(3))
        return scale.restore(networks.value_network.apply(statistics, params, obs))

    # 700 is subtracted and added again in float32: 700 * 2^-23 = 8e-5, a few times
    np.testing.assert_allclose(value(moved, new), value(params, old), atol=5e-4)


@pytest.mark.parametrize("count", [24, 7, 2])
def test_statistics_are_numpys_of_the_entries_that_count(count):
    """Skewed numbers, 1e-4: float32. Those without weight change nothing."""
    rng = np.random.default_rng(0)
    x, errors = np.exp(rng.normal(size=(2, 4, 6))).astype("f")
    weight = rng.permutation(np.arange(24) < count).reshape(4, 6).astype("f")
    kept, missed = x[weight > 0], errors[weight > 0]
    x, errors, weight = map(jnp.asarray, (x, errors, weight))
    found = standardized(x, weight)
    np.testing.assert_allclose(
        found, (x - kept.mean()) / kept.std(), rtol=1e-4, atol=1e-4
    )
    np.testing.assert_allclose(weighted_mean(x, weight), kept.mean(), rtol=1e-4)
    share = 1.0 - np.square(missed).mean() / kept.var()
    np.testing.assert_allclose(
        explained_variance(x, errors, weight), share, rtol=1e-4, atol=1e-4
    )


def test_the_mean_of_one_entry_is_that_entry_and_of_none_zero():
    x, none = jnp.arange(3.0) + 5.0, jnp.zeros(3)
    assert weighted_mean(x, none.at[1].set(1.0)) == 6.0
    assert weighted_mean(x, none) == 0.0
    assert np.isfinite(standardized(x, none)).all()
    np.testing.assert_array_equal(standardized(jnp.full(3, 7.0), none + 1.0), 0.0)
    assert np.isfinite(explained_variance(x, x, none))
