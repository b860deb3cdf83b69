"""Statistics against closed forms."""

import numpy as np
import pytest

from rmp_mjx.training.stats import bootstrap_mean, clopper_pearson, mean_sd


def test_no_event_in_n_trials_is_bounded_by_the_closed_form():
    low, high = clopper_pearson(0, 100)
    assert low == 0.0
    assert high == pytest.approx(1 - 0.025 ** (1 / 100), rel=1e-9)  # exact


def test_the_interval_is_symmetric_under_counting_the_failures():
    low, high = clopper_pearson(7, 50)
    other_low, other_high = clopper_pearson(43, 50)
    assert (low, high) == pytest.approx((1 - other_high, 1 - other_low), abs=1e-9)


@pytest.mark.parametrize("counts", [(-1, 10), (11, 10), (0, 0)])
def test_impossible_counts_are_refused(counts):
    with pytest.raises(ValueError, match="impossible"):
        clopper_pearson(*counts)


def test_deviation_of_a_single_value_is_zero():
    assert mean_sd(np.array([3.0])) == (3.0, 0.0)


def test_bootstrap_interval_is_near_the_normal_one():
    values = np.random.default_rng(0).normal(size=400)
    low, high = bootstrap_mean(values)
    half = 1.96 * values.std() / 20
    # 2,000 resamples leave a few per cent of noise in the quantiles
    assert (low, high) == pytest.approx(
        (values.mean() - half, values.mean() + half), abs=0.15 * half
    )


def test_bootstrap_of_a_constant_is_that_constant():
    assert bootstrap_mean(np.full(5, 2.0)) == (2.0, 2.0)
