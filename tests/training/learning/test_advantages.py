"""Advantages against Brax and against sums written out."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.agents.ppo.losses import compute_gae

from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.learning import value_scale
from rmp_mjx.training.learning.advantages import generalised_advantages, make_batch
from rmp_mjx.training.learning.loss import (
    explained_variance,
    standardized,
    weighted_mean,
)
from rmp_mjx.training.learning.rollout import Transition

T, B = 7, 5


def transitions(seed, truncated=False) -> Any:
    rng = np.random.default_rng(seed)
    termination = (rng.random((T, B)) < 0.2).astype(np.float32)
    truncation = (rng.random((T, B)) < 0.2) * (1.0 - termination) * truncated
    zeros = np.zeros((T, B, 1), np.float32)
    arrays: dict[str, Any] = {
        "obs": zeros,
        "next_obs": zeros,
        "raw_action": zeros,
        "log_prob": zeros[..., 0],
        "reward": rng.normal(size=(T, B)).astype(np.float32),
        "termination": termination,
        "truncation": truncation.astype(np.float32),
        "weight": np.ones((T, B), np.float32),
    }
    return Transition(**arrays)


def test_without_truncation_the_value_targets_are_those_of_brax():
    data = transitions(0)
    values: Any = np.random.default_rng(1).normal(size=(T + 1, B)).astype(np.float32)
    ours = generalised_advantages(data, values[:-1], values[1:], 0.9, 0.8)
    targets, _ = compute_gae(
        data.truncation,
        data.termination,
        data.reward,
        values[:-1],
        values[-1],
        lambda_=0.8,
        discount=0.9,
    )
    # same sums in float32, another order
    np.testing.assert_allclose(ours + values[:-1], targets, atol=1e-5)


def test_with_lambda_one_targets_are_discounted_sums_bootstrapped_at_time_limits():
    data = transitions(2, truncated=True)
    rng = np.random.default_rng(3)
    values, following = rng.normal(size=(2, T, B)).astype(np.float32)
    going_on = (data.termination + data.truncation)[:-1] == 0
    following[:-1] = np.where(going_on, values[1:], following[:-1])
    ours = generalised_advantages(data, values, following, 0.9, 1.0) + values
    for lane in range(B):
        for t in range(T):
            total, factor = 0.0, 1.0
            for k in range(t, T):
                total += factor * data.reward[k, lane]
                factor *= 0.9
                ended = data.termination[k, lane] > 0
                if ended or data.truncation[k, lane] > 0 or k == T - 1:
                    total += 0.0 if ended else factor * following[k, lane]
                    break
            # float32 against float64
            np.testing.assert_allclose(ours[t, lane], total, atol=1e-5)


def test_a_masked_step_has_no_advantage_and_passes_none_on():
    data = transitions(4)
    ones: Any = np.ones((T, B), np.float32)
    lost = ones * (np.arange(T) == 3)[:, None]
    masked = data.replace(weight=ones - lost, termination=lost)
    ours = generalised_advantages(masked, ones, ones, 0.9, 0.8)
    later = ones * (np.arange(T) >= 3)[:, None]
    other = masked.replace(reward=masked.reward + 5.0 * later)
    theirs = generalised_advantages(other, ones, ones, 0.9, 0.8)
    np.testing.assert_array_equal(ours[3], 0.0)
    np.testing.assert_array_equal(ours[:3], theirs[:3])
    assert jax.numpy.isfinite(ours).all()


T, B = 5, 4


@pytest.fixture
def data():
    """Episodes of one step: the targets are the rewards. One step does not count."""
    keys = jax.random.split(jax.random.key(0), 3)
    return Transition(
        obs=jax.random.normal(keys[0], (T, B, 3)),
        next_obs=jnp.zeros((T, B, 3)),
        raw_action=jax.random.normal(keys[1], (T, B, 2)),
        log_prob=jnp.zeros((T, B)),
        reward=5.0 + jax.random.normal(keys[2], (T, B)),
        termination=jnp.ones((T, B)),
        truncation=jnp.zeros((T, B)),
        weight=jnp.ones((T, B)).at[2, 1].set(0.0),
    )


def test_the_first_batch_is_normalized_by_its_own_moments(data):
    values = jnp.full((T, B), 4.0)
    batch, scale, metrics = make_batch(
        PPOConfig(), data, values, jnp.full((T, B), 1e3), value_scale.init()
    )
    counted = np.asarray(data.weight) > 0
    reward = np.asarray(data.reward)[counted]
    # float32 sums of 19 numbers
    assert float(scale.mean) == pytest.approx(reward.mean(), rel=1e-5)
    assert float(scale.std) == pytest.approx(reward.std(), rel=1e-5)
    target = (reward - reward.mean()) / reward.std()
    np.testing.assert_allclose(batch.target[counted], target, atol=1e-5)
    np.testing.assert_allclose(batch.advantage[counted], target, atol=1e-5)
    assert metrics["value_mean"] == 4.0
    np.testing.assert_array_equal(batch.weight, data.weight)


def test_right_values_explain_all_variance_and_constant_ones_none(data):
    scale, nothing = value_scale.init(), jnp.zeros((T, B))
    mean = weighted_mean(data.reward, data.weight)
    for values, share in ((data.reward, 1.0), (mean, 0.0)):
        values = jnp.broadcast_to(values, (T, B))
        _, _, metrics = make_batch(PPOConfig(), data, values, nothing, scale)
        found = float(metrics["explained_variance"])
        assert found == pytest.approx(share, abs=1e-5)


def test_statistics_leave_out_what_has_no_weight():
    x, weight = jnp.array([1.0, 3.0, np.pi]), jnp.array([1.0, 1.0, 0.0])
    assert weighted_mean(x, weight) == 2.0
    np.testing.assert_allclose(standardized(x, weight)[:2], [-1.0, 1.0], rtol=1e-6)
    errors = jnp.array([0.5, -0.5, 100.0])
    assert float(explained_variance(x, errors, weight)) == pytest.approx(0.75)


def test_no_weight_at_all_gives_finite_numbers():
    none = jnp.zeros(3)
    assert weighted_mean(jnp.ones(3), none) == 0.0
    assert np.isfinite(standardized(jnp.ones(3), none)).all()
    assert np.isfinite(explained_variance(jnp.ones(3), jnp.ones(3), none))
