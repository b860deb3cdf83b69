"""Distances of segments against a least-squares program with bounds."""

import numpy as np
from scipy.optimize import lsq_linear

from rmp_mjx.robot.configurations import segment_distance


def test_segments_have_their_least_distance():
    """Of 100 pairs by scipy, a fifth parallel, some touching.

    1e-7 m: the root of the rounding of a square.
    """
    rng = np.random.default_rng(0)
    a, b, c, d = rng.normal(size=(4, 100, 3))
    d[::5] = c[::5] + rng.normal(size=(20, 1)) * (b - a)[::5]  # parallel
    c[1::5] = 0.4 * a[1::5] + 0.6 * b[1::5]  # an end on the other segment

    def least(a, b, c, d):
        found = lsq_linear(np.column_stack([b - a, c - d]), c - a, (0.0, 1.0), "bvls")
        return np.sqrt(2.0 * found.cost)

    expected = [least(*ends) for ends in zip(a, b, c, d, strict=True)]
    np.testing.assert_allclose(segment_distance(a, b, c, d), expected, atol=1e-7)


def test_a_segment_without_length_is_a_point():
    zero, x, y = np.zeros((1, 3)), *np.eye(3)[:2, None]
    assert segment_distance(y, y, -x, x) == 1.0
    assert segment_distance(-x, x, y, y) == 1.0
    assert segment_distance(zero, zero, 2 * x, 2 * x) == 2.0
