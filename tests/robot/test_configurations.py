"""Random configurations and the arm's distances from itself in them."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from rmp_mjx.robot import configurations
from rmp_mjx.robot.configurations import (
    capsule_ends,
    capsule_gaps,
    joint_frames,
    random_configurations,
    segment_distance,
    touching_pairs,
)
from tests.oracles import Measured


@pytest.fixture(scope="module")
def drawn(bent):
    return random_configurations(bent, 2000)


def test_configurations_are_even_within_the_limits_or_a_turn(bent, drawn):
    """Tenths of 2000 hold 200 each: 50 is four standard deviations."""
    low = np.where(np.isfinite(bent.q_lower), bent.q_lower, -np.pi)
    high = np.where(np.isfinite(bent.q_upper), bent.q_upper, np.pi)
    for q, first, last in zip(drawn.T, low, high, strict=True):
        held = np.histogram(q, 10, (first, last))[0]
        assert held.sum() == 2000 and np.abs(held - 200).max() < 50
    np.testing.assert_array_equal(random_configurations(bent, 2000), drawn)
    assert not np.any(random_configurations(bent, 2000, seed=1) == drawn)


def test_joint_frames_move_with_their_bodies_and_z_is_the_axis(bent, drawn):
    """By MuJoCo C in 50 configurations; 1e-12: rounding of metres. A frame keeps its
    place on its body, and a hinge's is on its axis."""
    measured, places = Measured(bent), []
    p, R = joint_frames(bent, drawn[:50])
    assert p.shape == (4, 50, 3) and R.shape == (4, 50, 3, 3)
    for k, q in enumerate(drawn[:50]):
        data, place = measured.at(q), []
        for j, body in enumerate(bent.mj_model.jnt_bodyid):
            np.testing.assert_allclose(R[j, k, :, 2], data.xaxis[j], atol=1e-12)
            if bent.hinge[j]:
                np.testing.assert_allclose(p[j, k], data.xanchor[j], atol=1e-12)
            turn = data.xmat[body].reshape(3, 3).T
            place.append([turn @ (p[j, k] - data.xpos[body]), *(turn @ R[j, k]).T])
        places.append(place)
    np.testing.assert_allclose(places, np.tile(places[0], (50, 1, 1, 1)), atol=1e-12)
    gram = np.einsum("jsab,jsac->jsbc", R, R)
    np.testing.assert_allclose(gram, np.tile(np.eye(3), (4, 50, 1, 1)), atol=1e-12)


def test_capsules_are_as_far_apart_as_mujoco_says(bent, drawn):
    """All pairs, those with the fixed base too, in 50 configurations; 1e-9 m."""
    count, measured = len(bent.capsules.geom), Measured(bent)
    pairs = [(a, b) for a in range(count) for b in range(a)]
    expected = [measured.gaps(q, pairs) for q in drawn[:50]]
    found = capsule_gaps(bent, drawn[:50], pairs)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)
    assert found.min() < 0.0 < found.max()
    assert sorted(capsule_ends(bent, drawn[:2], [3, 1])) == [1, 3]


@pytest.mark.parametrize("shift", [0.0, 0.03, 0.07])
def test_watched_pairs_are_those_that_come_within_two_centimetres(bent, drawn, shift):
    """By MuJoCo C, three joints apart or more; also of thinner arms, whose capsules
    come less near."""
    segment, measured = bent.capsules.segment, Measured(bent)
    apart = [
        (far, near)
        for far in range(len(segment))
        for near in range(len(segment))
        if segment[far] - segment[near] > 2
    ]
    gaps = np.array([measured.gaps(q, apart) for q in drawn]).min(axis=0) + 2 * shift
    capsules = bent.capsules.replace(radius=bent.capsules.radius - shift)
    thin = bent.replace(capsules=capsules)
    expected = [pair for pair, gap in zip(apart, gaps, strict=True) if gap < 0.02]
    assert touching_pairs(thin) == tuple(expected)
    if not shift:
        assert bent.capsules.pairs == tuple(expected)


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


def test_two_thousand_configurations_are_drawn_from_a_fixed_seed(bent, monkeypatch):
    """Links that come near in the last of them only are watched."""
    low = np.where(np.isfinite(bent.q_lower), bent.q_lower, -np.pi)
    high = np.where(np.isfinite(bent.q_upper), bent.q_upper, np.pi)
    drawn = np.random.default_rng(0).uniform(low, high, (2000, 4))
    np.testing.assert_array_equal(random_configurations(bent, 2000), drawn)

    def gaps(robot, q, pairs):
        last = (q == drawn[-1]).all(axis=1)
        return np.where(last[:, None], [0.0, *[1.0] * (len(pairs) - 1)], 1.0)

    monkeypatch.setattr(configurations, "capsule_gaps", gaps)
    assert len(touching_pairs(bent)) == 1
