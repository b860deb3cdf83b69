"""Numbers from the store: curves and their areas, best seeds, rates, paired tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import polars as pl
from jaxtyping import Float
from scipy import stats as scipy_stats

from envs.safety import ENDING
from rmp_mjx.training.stats import (
    Interval,
    bootstrap_mean,
    clopper_pearson,
    mean_sd,
)

LAST = 0.1
"""Share of training, at its end, whose mean return ranks the seeds."""
RESAMPLES = 4000
"""Resamples of a bootstrap over seeds."""


class Curves(NamedTuple):
    """One measure over training, a line for each seed."""

    seeds: tuple[int, ...]
    """Seeds, ascending."""
    steps: Float[np.ndarray, " t"]
    """Policy steps."""
    values: Float[np.ndarray, "k t"]
    """Values; NaN before the first episode finished."""


def of(rows: pl.DataFrame, **place: str | int) -> pl.DataFrame:
    """The rows of a task, variant, seed or column."""
    if rows.is_empty():
        return rows
    return rows.filter(**place)


def seeds(rows: pl.DataFrame) -> list[int]:
    """Seeds in some rows, ascending."""
    return [] if rows.is_empty() else sorted(rows["seed"].unique().to_list())


def curves(rows: pl.DataFrame, name: str) -> Curves:
    """A column of training rows of one task and variant, seed by seed.

    Iterations in which no episode finished take the line between their neighbours.
    """
    found = tuple(seeds(rows))
    table = rows.pivot(on="seed", index="steps", values=name).sort("steps")
    steps = table["steps"].to_numpy().astype(float)
    lines = []
    for seed in found:
        line = table[str(seed)].cast(pl.Float64).to_numpy()
        known = ~np.isnan(line)
        filled = np.full(len(line), np.nan)
        if known.any():
            filled = np.interp(steps, steps[known], line[known], left=np.nan)
        lines.append(filled)
    return Curves(found, steps, np.array(lines))


def band(
    values: Float[np.ndarray, "k t"],
) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, "2 t"]]:
    """Mean over the seeds and its 95 % interval by Student's t; none for one seed."""
    count = np.sum(~np.isnan(values), axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.nansum(values, axis=0) / count
        spread = np.nansum((values - mean) ** 2, axis=0) / (count - 1.0)
        half = scipy_stats.t.ppf(0.975, np.maximum(count - 1, 1)) * np.sqrt(
            spread / count
        )
    half = np.where(count > 1, half, 0.0)
    return mean, np.stack([mean - half, mean + half])


def areas(own: Curves, other: Curves) -> tuple[np.ndarray, np.ndarray]:
    """Area under each seed's curve, over the steps where both curves have values.

    Returns:
        Areas (k,) of either, divided by the range: mean heights.
    """
    start = max(_first(own), _first(other))
    end = min(own.steps[-1], other.steps[-1])
    return _area(own, start, end), _area(other, start, end)


def _first(curves: Curves) -> float:
    known = ~np.isnan(curves.values).any(axis=0)
    return float(curves.steps[np.argmax(known)]) if known.any() else np.inf


def _area(curves: Curves, start: float, end: float) -> np.ndarray:
    inside = (curves.steps >= start) & (curves.steps <= end)
    x, y = curves.steps[inside], curves.values[:, inside]
    if len(x) < 2:
        return np.full(len(y), np.nan)
    return np.trapezoid(y, x, axis=1) / (x[-1] - x[0])


def percent_change(
    own: Float[np.ndarray, " k"], base: Float[np.ndarray, " k"]
) -> float:
    """Change of the area under the mean curve, as the paper has it [%].

    The mean curve's area is the mean of the areas. NaN where the base has none.
    """
    reference = float(np.mean(base))
    if not reference > 0.0:
        return float("nan")
    return 100.0 * (float(np.mean(own)) / reference - 1.0)


def change_interval(
    own: Float[np.ndarray, " k"], base: Float[np.ndarray, " k"], seed: int = 0
) -> Interval | None:
    """95 % percentile bootstrap interval of the change over paired seeds [%].

    None for fewer than three pairs or where the base has no area.
    """
    pairs = min(len(own), len(base))
    if pairs < 3 or not np.mean(base) > 0.0:
        return None
    drawn = np.random.default_rng(seed).integers(pairs, size=(RESAMPLES, pairs))
    reference = base[drawn].mean(axis=1)
    change = 100.0 * (
        own[drawn].mean(axis=1) / np.where(reference > 0, reference, 1.0) - 1
    )
    low, high = np.percentile(change[reference > 0], [2.5, 97.5])
    return float(low), float(high)


def best_seed(rows: pl.DataFrame) -> int:
    """The seed with the greatest mean return over the last tenth of training.

    Args:
        rows: Training rows of one task and variant. Iterations count by the episodes
            that finished in them; of equal seeds the first is taken, and a seed of
            which no episode finished comes last.
    """
    late = rows.filter(pl.col("steps") > (1.0 - LAST) * pl.col("steps").max())
    weight = pl.col("episode/finished")
    means = late.group_by("seed").agg(
        ((pl.col("episode/return") * weight).sum() / weight.sum()).alias("mean")
    )
    means = means.with_columns(pl.col("mean").fill_nan(None))
    ranked = means.sort(["mean", "seed"], descending=[True, False], nulls_last=True)
    return int(ranked["seed"][0])


def training_forces(rows: pl.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """Contact forces of the episodes that a contact ended in training.

    Training keeps means over the episodes that finished in an iteration. The greatest
    contact force of an episode without contact is 0, so their mean times the number of
    episodes, over the number of those with a contact, is the mean over the latter.

    Returns:
        Forces [N] and how many episodes each stands for; mostly 1 late in training.
    """
    number = pl.col("episode/finished") * (
        pl.col("episode/collision") + pl.col("episode/self_collision")
    )
    force = pl.col("episode/contact_force_peak") * pl.col("episode/finished") / number
    found = rows.select(force=force, number=number).filter(pl.col("number") > 0)
    return found["force"].to_numpy(), found["number"].to_numpy()


@dataclass(frozen=True)
class Rate:
    """A share of episodes."""

    hits: int
    """Episodes with the event."""
    count: int
    """Episodes."""

    @property
    def percent(self) -> float:
        """The share [%]."""
        return 100.0 * self.hits / self.count

    @property
    def interval(self) -> Interval:
        """Its 95 % Clopper-Pearson interval [%]."""
        low, high = clopper_pearson(self.hits, self.count)
        return 100.0 * low, 100.0 * high


def rate(rows: pl.DataFrame, name: str) -> Rate:
    """Episodes in which a metric is above a half: success, or any event."""
    return Rate(int((rows[name] > 0.5).sum()), len(rows))


def ended(rows: pl.DataFrame) -> Rate:
    """Episodes that any event ended."""
    return Rate(
        int(rows.select(pl.any_horizontal(pl.col(ENDING) > 0.5)).sum().item()),
        len(rows),
    )


def events(rows: pl.DataFrame) -> float:
    """Events in some trainings, whose iterations all have the same number of steps."""
    each = [f"per_1000_steps/{name}" for name in ENDING]
    seeds, last = rows["seed"].n_unique(), float(rows["steps"].max())  # pyright: ignore
    return seeds * last / 1000.0 * sum(float(rows[name].mean()) for name in each)  # pyright: ignore


class Mean(NamedTuple):
    """A mean over episodes."""

    mean: float
    """The mean."""
    sd: float
    """Standard deviation of an episode."""
    interval: Interval
    """95 % bootstrap interval of the mean."""


def mean(rows: pl.DataFrame, name: str) -> Mean:
    """Mean of a metric over episodes."""
    values = rows[name].to_numpy()
    return Mean(*mean_sd(values), bootstrap_mean(values))


def gap(
    ours: pl.DataFrame, base: pl.DataFrame, name: str, factor: float = 1.0
) -> Interval:
    """95 % bootstrap interval of the mean difference of a metric.

    Args:
        ours: Episodes of one.
        base: As many of the other, from the same starts in the same order.
        name: The metric.
        factor: Of the differences.
    """
    differences = ours[name].to_numpy() - base[name].to_numpy()
    return bootstrap_mean(factor * differences.astype(float))


class Paired(NamedTuple):
    """Ours against VICES, seed by seed."""

    pairs: int
    """Seeds."""
    difference: float
    """Mean of ours minus VICES'."""
    interval: Interval
    """Its 95 % interval by Student's t."""
    p_t: float
    """Two-sided p-value of the paired t-test."""
    p_sign: float
    """Two-sided p-value of the exact sign-flip test: with k pairs never below
    2 / 2^k."""
    effect: float
    """Cohen's d of the differences."""


def paired(own: Mapping[int, float], other: Mapping[int, float]) -> Paired | None:
    """Compare values by seed; None for fewer than two seeds in common."""
    both = sorted(
        seed
        for seed in own.keys() & other.keys()
        if np.isfinite(own[seed]) and np.isfinite(other[seed])
    )
    if len(both) < 2:
        return None
    gaps = np.array([own[seed] - other[seed] for seed in both])
    middle, sd = mean_sd(gaps)
    if sd == 0.0:
        p_t, effect, half = float(middle == 0.0), float("nan"), 0.0
    else:
        _, p_t = map(float, scipy_stats.ttest_1samp(gaps, 0.0))
        effect = middle / sd
        half = sd / np.sqrt(len(gaps)) * scipy_stats.t.ppf(0.975, len(gaps) - 1)
    interval = (middle - half, middle + half)
    return Paired(len(both), middle, interval, p_t, _sign_flip(gaps), effect)


def _sign_flip(gaps: Float[np.ndarray, " k"]) -> float:
    """p-value of the mean over all ways to flip the signs of the differences."""
    flips = np.array(np.meshgrid(*[[1.0, -1.0]] * len(gaps))).reshape(len(gaps), -1)
    means = np.abs(gaps @ flips)
    return float(np.mean(means >= means[0] * (1 - 1e-12)))
