"""What is learned from transitions, in the units of the new scale."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.learning import value_scale
from rmp_mjx.training.learning.rollout import Transition
from rmp_mjx.training.learning.targets import make_batch
from rmp_mjx.training.learning.weighted import (
    explained_variance,
    standardized,
    weighted_mean,
)

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
