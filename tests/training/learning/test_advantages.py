"""Advantages against Brax and against sums written out."""

from typing import Any

import jax
import numpy as np
from brax.training.agents.ppo.losses import compute_gae

from rmp_mjx.training.learning.advantages import generalised_advantages
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
