"""Fitted capsules contain the whole hull, with little to spare."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from rmp_mjx.robot.enclose import (
    THICK,
    Capsule,
    _about,
    _best_cut,
    _cut,
    _extreme,
    _principal,
    distance_to_segment,
    enclosing_capsule,
    enclosing_capsules,
    hull_volume,
)

SIGNS = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T


def outside(capsules, points):
    """How far each point sticks out of the union, (k,) [m]."""
    gaps = [distance_to_segment(points, *c[:2]) - c.radius for c in capsules]
    return np.min(gaps, axis=0)


@settings(max_examples=15, deadline=None)
@given(
    points=arrays(float, (8, 3), elements=st.floats(-1, 1, width=32)),
    stretch=arrays(float, 3, elements=st.floats(0.01, 1.0)),
    seed=st.integers(0, 1000),
)
def test_the_capsules_enclose_every_corner_and_all_between(points, stretch, seed):
    """Also flat, thin and repeated points. 1e-6 m: the cuts' corners are rounded."""
    rng = np.random.default_rng(seed)
    points = Rotation.random(rng=rng).apply(points * stretch) + rng.normal(size=3)
    capsules = enclosing_capsules(points)
    within = rng.dirichlet(np.full(8, 0.4), 300) @ points
    assert outside(capsules, np.concatenate([points, within])).max() < 1e-6


def test_a_capsule_is_found_again():
    """Points on its surface: 1.03, the search ends within a few per cent."""
    rng = np.random.default_rng(0)
    on = rng.normal(size=(600, 3))
    on *= 0.05 / np.linalg.norm(on, axis=1)[:, None]
    on[:, 2] += np.where(on[:, 2] > 0, 0.2, -0.2)
    turn = Rotation.random(rng=rng)
    capsule = enclosing_capsule(turn.apply(on) + 2.0)
    true = np.pi * 0.05**2 * (0.4 + 4 / 3 * 0.05)
    assert capsule.volume < 1.03 * true
    axis = (capsule.end - capsule.start) / np.linalg.norm(capsule.end - capsule.start)
    assert abs(axis @ turn.apply([0, 0, 1])) > 0.999


@pytest.mark.parametrize(
    ("half", "most"),
    [([0.2, 0.02, 0.02], 1.75), ([0.1, 0.05, 0.05], 2.25), ([0.1, 0.05, 0.01], 2.6)],
    ids=["beam", "brick", "plate"],
)
def test_boxes_cost_little(half, most):
    """A box's corners stick out of any thin capsule: about 1.6 at best (a beam)."""
    corners = SIGNS * half
    capsules = enclosing_capsules(corners)
    assert sum(c.volume for c in capsules) < most * hull_volume(corners)


def test_a_plate_gets_several_capsules_and_a_link_one():
    plate, link = SIGNS * [0.1, 0.1, 0.01], SIGNS * [0.2, 0.03, 0.03]
    assert len(enclosing_capsules(plate)) == 3
    assert len(enclosing_capsules(link)) == 1
    assert len(enclosing_capsules(plate, most=1)) == 1
    one = enclosing_capsule(plate).volume
    assert sum(c.volume for c in enclosing_capsules(plate)) < 0.5 * one
    assert one > THICK * hull_volume(plate)


def on_a_sphere(count, seed=0):
    x = np.random.default_rng(seed).normal(size=(count, 3))
    return x / np.linalg.norm(x, axis=1)[:, None]


def test_distances_to_a_segment_are_least_squares():
    """Of 60 points by scipy, 1e-9; and to a segment of no length."""
    rng = np.random.default_rng(0)
    points, (start, end) = rng.normal(size=(60, 3)), 0.5 * rng.normal(size=(2, 3))
    along = (end - start)[:, None]
    expected = [
        np.sqrt(2.0 * lsq_linear(along, x - start, (0.0, 1.0), "bvls").cost)
        for x in points
    ]
    found = distance_to_segment(points, start, end)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    alone = distance_to_segment(points, start, start)
    np.testing.assert_allclose(alone, np.linalg.norm(points - start, axis=1))


def test_a_capsules_volume_is_that_of_a_cylinder_and_a_ball():
    """0.3 m long, 0.1 m thick; a ball has no cylinder."""
    x = np.array([0.1, 0.2, 0.2])
    capsule = Capsule(2.0 * x, x, 0.1)
    ball = 4.0 / 3.0 * np.pi * 1e-3
    np.testing.assert_allclose(capsule.volume, np.pi * 1e-2 * 0.3 + ball)
    np.testing.assert_allclose(Capsule(x, x, 0.1).volume, ball)
    assert hull_volume(SIGNS) == pytest.approx(8.0)
    assert hull_volume(SIGNS * [1.0, 1.0, 0.0]) == 0.0


def test_the_capsule_about_an_axis_is_the_shortest_of_its_radius():
    """Shift, tilt and radius as asked; all points inside, and none of its ends can be
    drawn in, by 1e-6. Rounding: 1e-9."""
    rng = np.random.default_rng(0)
    for k in range(30):
        points = rng.normal(size=(20, 3)) * [0.2, 0.3, 1.0 if k % 2 else 0.1]
        p = rng.normal(size=5) * [0.1, 0.1, 0.3, 0.3, 0.2]
        start, end, radius = _about(points, p)
        foot, way = np.array([p[0], p[1], 0.0]), np.array([p[2], p[3], 1.0])
        off = np.linalg.norm(np.cross(points - foot, way), axis=1)
        least = off.max() / np.linalg.norm(way)
        np.testing.assert_allclose(radius, least * (1.0 + abs(p[4])))
        for x in (start, end):
            np.testing.assert_allclose(np.cross(x - foot, way), 0.0, atol=1e-9)
        assert distance_to_segment(points, start, end).max() < radius + 1e-9
        length = np.linalg.norm(end - start)
        assert length == 0.0 or (end - start) @ way > 0.0
        if length > 0.0:
            step = 1e-6 * (end - start)
            for ends in ((start + step, end), (start, end - step)):
                assert distance_to_segment(points, *ends).max() > radius


def test_extreme_points_support_a_hull_from_every_side():
    """A hundred spread evenly are at most 0.31 rad from any direction."""
    ball = on_a_sphere(4000)
    chosen = _extreme(ball)
    assert 90 <= len(chosen) <= 100
    assert (on_a_sphere(2000, 1) @ ball[chosen].T).max(axis=1).min() > np.cos(0.31)
    np.testing.assert_array_equal(
        _extreme(np.vstack([0.5 * SIGNS, SIGNS])), range(8, 16)
    )


def test_the_principal_box_touches_the_points_on_every_side():
    rng = np.random.default_rng(0)
    turn = Rotation.random(rng=rng).as_matrix()
    points = rng.uniform(-1, 1, (200, 3)) * [0.1, 1.0, 0.4] @ turn.T + 3.0
    centre, axes, half = _principal(points)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    x = (points - centre) @ axes
    np.testing.assert_allclose(x.max(axis=0), half, atol=1e-12)
    np.testing.assert_allclose(x.min(axis=0), -half, atol=1e-12)
    spread = np.cov(x.T)
    assert np.all(np.diff(np.diag(spread)) < 0.0)  # the longest axis first
    np.testing.assert_allclose(spread - np.diag(np.diag(spread)), 0.0, atol=1e-12)


def test_a_cut_parts_a_hull_along_a_plane():
    """The volumes add up, 1e-12; a plane beside the hull cuts nothing off."""
    rng = np.random.default_rng(0)
    for k in range(20):
        points, normal = rng.normal(size=(12, 3)), on_a_sphere(1, k)[0]
        height = points @ normal
        level = rng.uniform(*np.quantile(height, [0.2, 0.8]))
        pieces = _cut(points, normal, level)
        assert pieces is not None
        below, above = pieces
        assert (below @ normal < level + 1e-12).all()
        assert (above @ normal > level - 1e-12).all()
        parts = hull_volume(below) + hull_volume(above)
        np.testing.assert_allclose(parts, hull_volume(points), rtol=1e-12)
        assert min(hull_volume(below), hull_volume(above)) > 0.0
        assert _cut(points, normal, height.max() + 0.1) is None
        assert _cut(points, normal, height.min() - 0.1) is None


def test_the_best_cut_is_in_the_middle_of_a_plate_and_near_a_wedges_edge():
    """The wedge is cut a quarter from its broad end, whichever way it points."""
    halves = _best_cut(SIGNS * [0.1, 0.1, 0.01])
    assert halves is not None
    np.testing.assert_allclose([hull_volume(x) for x in halves], 4e-4)
    edge = np.array([[0, 0.2, 0.1], [0, -0.2, 0.1], [1, 0.02, 0.1], [1, -0.02, 0.1]])
    wedge = np.concatenate([edge, edge * [1, 1, -1]])
    for points in (wedge, -wedge, wedge[:, [1, 2, 0]]):
        pieces = _best_cut(points)
        assert pieces is not None
        broad = np.sort(np.ptp(min(pieces, key=hull_volume), axis=0))
        np.testing.assert_allclose(broad, [0.2, 0.25, 0.4], atol=1e-9)
