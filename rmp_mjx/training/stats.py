"""Statistics of evaluation episodes."""

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


def bootstrap_mean(
    values: Float[np.ndarray, " n"], confidence: float = 0.95, seed: int = 0
) -> Interval:
    """Percentile bootstrap interval of the mean.

    Args:
        values: Sample, (n,).
        confidence: Coverage, in (0, 1).
        seed: Seed of the resampling.

    Returns:
        Lower and upper bound; both the value itself for a constant sample.
    """
    values = np.asarray(values, np.float64)
    if values.size < 2 or np.ptp(values) == 0.0:
        return float(values[0]), float(values[0])
    result = scipy_stats.bootstrap(
        (values,),
        np.mean,
        confidence_level=confidence,
        n_resamples=2000,
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    low, high = result.confidence_interval
    return float(low), float(high)
