"""PPO on toy tasks, each isolating one fault; and its guards."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.learning.ppo import make_ppo
from tests.training import toys

CONFIG = PPOConfig(
    num_envs=32,
    unroll_length=8,
    num_minibatches=4,
    num_updates_per_batch=8,
    learning_rate=3e-3,
    value_learning_rate=3e-3,
    hidden_sizes=(16,),
    discounting=0.9,
)


def action(ppo, state, obs):
    mean, _ = ppo.networks.policy_network.apply(
        state.normalizer, state.learner.policy, jnp.array([[obs]])
    )
    return float(mean[0, 0])


class Trained:
    """A few iterations on a toy task, and what they learned."""

    def __init__(self, env, iterations, config=CONFIG):
        self.ppo = make_ppo(env, config)
        state = jax.jit(self.ppo.init)(jax.random.key(0))
        iterate: Any = jax.jit(self.ppo.iterate)
        self.history = []
        for _ in range(iterations):
            state, self.stats, metrics = iterate(state)
            self.history.append(jax.device_get(metrics))
        self.state = state
        assert iterate._cache_size() == 1, "an iteration was compiled twice"

    def value(self, obs):
        outputs = self.ppo.networks.value_network.apply(
            self.state.normalizer, self.state.learner.value, jnp.array([[obs]])
        )
        return float(self.state.scale.restore(outputs)[0])


def test_the_value_of_a_constant_reward_is_learned():
    assert Trained(toys.ConstantReward(), 10).value(0.0) == pytest.approx(1.0, abs=0.05)


def test_the_value_uses_the_observation():
    trained = Trained(toys.ObservedReward(), 15)
    # the learner's own error after 15 iterations
    assert trained.value(1.0) == pytest.approx(1.0, abs=0.1)
    assert trained.value(-1.0) == pytest.approx(-1.0, abs=0.1)


def test_a_later_reward_is_discounted():
    trained = Trained(toys.DelayedReward(), 25)
    assert trained.value(1.0) == pytest.approx(1.0, abs=0.04)
    assert trained.value(0.0) == pytest.approx(0.9, abs=0.04)


def test_a_time_limit_is_no_end_for_the_value():
    # 1 / (1 - 0.9) = 10; treating the limit as an end would give at most 4.1
    trained = Trained(toys.EndlessReward(), 40)
    assert trained.value(0.0) == pytest.approx(10.0, abs=0.7)


def test_the_better_action_is_chosen_and_updates_stop_beyond_the_target_kl():
    trained = Trained(toys.ActionChoice(), 40)
    epochs = [metrics["policy_epochs"] for metrics in trained.history]
    assert min(epochs) < max(epochs) == CONFIG.num_updates_per_batch
    assert action(trained.ppo, trained.state, 0.0) == pytest.approx(0.5, abs=0.1)


def test_lanes_that_become_nonfinite_do_not_keep_the_rest_from_learning():
    trained = Trained(toys.Exploding(), 40)
    assert int(trained.stats.nonfinite) > 0
    for leaf in jax.tree.leaves((trained.state.learner, trained.history)):
        assert np.isfinite(leaf).all()
    assert action(trained.ppo, trained.state, 0.0) == pytest.approx(0.5, abs=0.1)


def test_the_first_iteration_only_measures_observations():
    ppo = make_ppo(toys.ObservedReward(), CONFIG)
    state = jax.jit(ppo.init)(jax.random.key(0))
    new, _, _ = jax.jit(ppo.iterate)(state)
    same = jax.tree.map(jnp.array_equal, new.learner.policy, state.learner.policy)
    assert all(jax.tree.leaves(same))
    assert int(new.normalizer.count) == CONFIG.steps_per_iteration
    assert int(new.iteration) == 1


def test_seeds_are_a_batch_axis_and_the_action_depends_on_the_observation():
    ppo = make_ppo(toys.ActionFromObservation(), CONFIG)
    states = jax.jit(jax.vmap(ppo.init))(jax.random.split(jax.random.key(0), 2))
    iterate = jax.jit(jax.vmap(ppo.iterate))
    states, stats, _ = iterate(states)
    for _ in range(49):
        states, stats, _ = iterate(states)
    assert stats.episode_sums["return"][0] != stats.episode_sums["return"][1]
    for seed in range(2):
        state = jax.tree.map(lambda x, seed=seed: x[seed], states)
        assert action(ppo, state, 1.0) == pytest.approx(0.5, abs=0.15)
        assert action(ppo, state, -1.0) == pytest.approx(-0.5, abs=0.15)


def test_the_noise_of_the_actions_falls_as_it_is_told():
    """Over the last third of six iterations, from the first deviation to the last."""
    steps = 6 * CONFIG.steps_per_iteration
    config = dataclasses.replace(CONFIG, final_log_std=-2.0, anneal_steps=steps)
    std = [h["action_std"] for h in Trained(toys.ActionChoice(), 8, config).history]
    free = [h["action_std"] for h in Trained(toys.ActionChoice(), 8).history]
    np.testing.assert_array_equal(std[:4], free[:4])
    assert std[4] <= np.exp(-1.25) * (1 + 1e-6) < free[4]
    assert max(std[5:]) <= np.exp(-2.0) * (1 + 1e-6)
