"""Verdicts of targets by their intervals."""

import numpy as np
import pytest

from benchmarks.paper import measures, targets


@pytest.mark.parametrize(
    ("interval", "verdict"),
    [
        ((0.1, 0.2), True),
        ((0.0, 0.0), True),
        ((-0.2, -0.1), False),
        ((-0.1, 0.1), None),
        ((np.nan, 1.0), None),
        (None, None),
    ],
)
def test_a_verdict_needs_the_whole_interval_on_one_side(interval, verdict):
    assert targets.at_least(interval, 0.0) is verdict
    mirrored = interval and (-interval[1], -interval[0])
    assert targets.at_most(mirrored, 0.0) is verdict


@pytest.mark.parametrize(
    ("hits", "count", "verdict"),
    [(0, 1000, True), (0, 100, None), (1, 10_000, False)],  # upper ends: 0.37, 3.6 %
)
def test_an_event_never_happens_if_enough_episodes_have_none(hits, count, verdict):
    assert targets.never(measures.Rate(hits, count)) is verdict
