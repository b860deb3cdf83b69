"""Statistics of evaluation episodes and of training seeds."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats as scipy_stats

Interval = tuple[float, float]


def clopper_pearson(successes: int, trials: int, confidence: float = 0.95) -> Interval:
    """Exact binomial confidence interval (Clopper and Pearson, 1934).

    Args:
        successes: Number of trials with the event, 0 .. trials.
        trials: Number of independent trials, at least 1.
        confidence: Coverage, in (0, 1).

    Returns:
        Lower and upper bound of the event's probability.

    Raises:
        ValueError: The counts are impossible.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"impossible counts: {successes} of {trials}")
    interval = scipy_stats.binomtest(successes, trials).proportion_ci(
        confidence_level=confidence, method="exact"
    )
    return float(interval.low), float(interval.high)


def mean_sd(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Mean and sample standard deviation (0 for a single value)."""
    values = np.asarray(values, np.float64)
    sd = float(values.std(ddof=1)) if values.size > 1 else 0.0
    return float(values.mean()), sd


def interquartile_mean(
    values: Float[np.ndarray, "*n"], axis: int = 0
) -> Float[np.ndarray, "*m"]:
    """Mean of the middle half (Agarwal et al., 2021); of all where they are under four.

    One seed that fails or excels hardly moves it, yet it needs fewer seeds than the
    median.
    """
    return np.asarray(scipy_stats.trim_mean(values, 0.25, axis=axis))


def bootstrap_mean(
    values: Float[np.ndarray, " n"],
    confidence: float = 0.95,
    seed: int = 0,
    statistic: Callable[..., Any] = np.mean,
) -> Interval:
    """Percentile bootstrap interval of a mean.

    Args:
        values: Sample, (n,).
        confidence: Coverage, in (0, 1).
        seed: Seed of the resampling.
        statistic: The mean, along a given `axis`.

    Returns:
        Lower and upper bound; both the value itself for a constant sample.
    """
    values = np.asarray(values, np.float64)
    if values.size < 2 or np.ptp(values) == 0.0:
        return float(values[0]), float(values[0])
    result = scipy_stats.bootstrap(
        (values,),
        statistic,
        confidence_level=confidence,
        n_resamples=2000,
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    low, high = result.confidence_interval
    return float(low), float(high)


def bootstrap_curve(
    values: Float[np.ndarray, "k t"], confidence: float = 0.95, seed: int = 0
) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, " t"]]:
    """Percentile bootstrap interval of the interquartile mean at each point of a curve.

    Args:
        values: Curves of k seeds.
        confidence: Coverage, in (0, 1).
        seed: Seed of the resampling.

    Returns:
        Lower and upper bound; both the curve itself for a single seed.
    """
    values = np.asarray(values, np.float64)
    if len(values) < 2:
        return values[0], values[0]
    interval = scipy_stats.bootstrap(
        (values,),
        interquartile_mean,
        axis=0,
        confidence_level=confidence,
        n_resamples=1000,
        batch=100,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return interval.low, interval.high
