"""The search for capsules: how good, how long, and in any size."""

import numpy as np
import pytest

from rmp_mjx.robot import enclose
from rmp_mjx.robot.enclose import (
    _about,
    _cut,
    _extreme,
    distance_to_segment,
    enclosing_capsule,
    enclosing_capsules,
    hull_volume,
)
from tests.robot.test_enclose import SIGNS, on_a_sphere, outside

LEAST = {
    0: 2.5252,
    3: 12.4611,
    5: 4.5037,
    7: 2.5426,
    9: 12.9782,
    51: 14.0189,
}
"""By 24 searches each from a random axis, ten times as fine, for the points of a seed;
the axis of the last one is the second longest of the points."""


def cloud(seed):
    rng = np.random.default_rng(seed)
    few = rng.normal(size=(5 if seed == 51 else 10, 3))
    return few * (1.0 if seed == 51 else rng.uniform(0.3, 1, 3))


@pytest.mark.parametrize(("seed", "least"), LEAST.items())
def test_the_capsule_is_nearly_the_least(seed, least):
    """Within 0.4 %; and it has no point outside, to the last bit."""
    points = cloud(seed)
    capsule = enclosing_capsule(points)
    assert capsule.volume < 1.004 * least
    assert distance_to_segment(points, *capsule[:2]).max() <= capsule.radius


def test_a_search_ends_when_it_does_not_get_better(monkeypatch):
    """After a third of the 400 steps about each axis that there may be at most."""
    calls = []

    def about(points, p):
        calls.append(p)
        return _about(points, p)

    monkeypatch.setattr(enclose, "_about", about)
    enclosing_capsule(cloud(4))
    assert 300 < len(calls) < 900
    calls.clear()
    enclosing_capsule(cloud(4), steps=20)
    assert 60 <= len(calls) < 80


@pytest.mark.parametrize("size", [2.0**-12, 2.0**12])
def test_size_does_not_matter(size):
    """A power of two: the same numbers to rounding."""
    plate = SIGNS * [0.1, 0.07, 0.01] + 0.3
    one, other = enclosing_capsules(plate), enclosing_capsules(plate * size)
    assert len(one) == len(other) == 3
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(b.start, a.start * size, rtol=1e-9)
        np.testing.assert_allclose(b.end, a.end * size, rtol=1e-9)
        np.testing.assert_allclose(b.radius, a.radius * size, rtol=1e-9)


def test_a_point_and_a_line_have_capsules_without_volume():
    """1e-6: the search about a line ends there."""
    point, line = np.array([[1.0, 2.0, 3.0]]), np.array([[0.0, 0, 1], [1.0, 2, 3]])
    for points in (point, np.repeat(point, 4, axis=0)):
        (capsule,) = enclosing_capsules(points)
        np.testing.assert_allclose(capsule.start, point[0], atol=1e-9)
        np.testing.assert_allclose(capsule.end, point[0], atol=1e-9)
        assert capsule.radius < 1e-6
    (capsule,) = enclosing_capsules(line)
    assert outside([capsule], line).max() <= 0.0
    assert capsule.volume < 1e-3


def frustum(share):
    """A metre long, 5 cm thick at one end and a share of it at the other."""
    turn = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    ring = 0.05 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    ends = [(ring, 0.0), (share * ring, 1.0)]
    return np.concatenate([np.insert(x, 2, z, axis=1) for x, z in ends])


def test_a_hull_is_cut_where_that_is_needed_and_worth_it():
    """A frustum's volume is its length times R^2 + R r + r^2, by pi / 3. One of 1.88
    times its volume stays one, though two would be 0.79 of that; one of 2.22 is cut. A
    cube of 2.64 times its volume stays one, since two would be larger."""
    for share, count in ((0.45, 1), (0.3, 2)):
        points = frustum(share)
        ratio = enclosing_capsule(points).volume / hull_volume(points)
        assert len(enclosing_capsules(points)) == count
        assert (ratio > 2.0) == (count == 2) and 1.8 < ratio < 2.4
    assert len(enclosing_capsules(0.05 * SIGNS)) == 1


@pytest.mark.parametrize("taper", [-0.5, 0.5])
def test_all_capsules_of_a_plate_together_enclose_it(taper):
    """Wider at one end or the other; four of them, where there may be four."""
    plate = SIGNS * [0.1, 0.1, 0.01]
    plate[:, 1] *= 1.0 + taper * np.sign(plate[:, 0])
    within = np.random.default_rng(0).dirichlet(np.full(8, 0.4), 2000) @ plate
    capsules = enclosing_capsules(plate, most=4)
    assert len(capsules) == 4
    assert outside(capsules, np.concatenate([plate, within])).max() < 1e-6


def test_directions_are_those_of_a_fibonacci_sphere():
    """A hundred, at even heights, each turned on by the golden angle."""
    golden, k = np.pi * (3.0 - np.sqrt(5.0)), np.arange(0.5, 100.0)
    z = 0.99 - 0.02 * np.arange(100)
    ring = np.sqrt(1.0 - z**2)
    directions = np.stack([ring * np.cos(golden * k), -ring * np.sin(golden * k), z])
    ball = on_a_sphere(5000)
    nearest = np.argmax(ball @ directions, axis=0)
    np.testing.assert_array_equal(_extreme(ball), np.unique(nearest))


def test_points_on_an_axis_have_no_radius():
    """Also where rounding puts them beside it; and the radius asked for is enough."""
    rng = np.random.default_rng(0)
    for _ in range(100):
        p = np.append(rng.normal(size=4), 0.0)
        way = np.array([p[2], p[3], 1.0])
        start, end, radius = _about(
            np.array([[p[0], p[1], 0.0]]) + rng.normal() * way, p
        )
        assert np.isfinite([*start, *end]).all() and radius < 1e-6
        start, end, radius = _about(rng.normal(size=(5, 3)), p)
        assert np.isfinite([*start, *end, radius]).all()


def test_a_cut_through_corners_keeps_them_on_both_sides():
    """An octahedron through its equator: pyramids of 2/3, half of the whole each."""
    octahedron = np.concatenate([np.eye(3), -np.eye(3)])
    for normal in np.eye(3):
        pieces = _cut(octahedron, normal, 0.0)
        assert pieces is not None
        for piece, side in zip(pieces, (-1.0, 1.0), strict=True):
            assert hull_volume(piece) == pytest.approx(2.0 / 3.0)
            assert len(piece) == 5 and (side * piece @ normal >= 0.0).all()


def test_distances_of_points_in_any_shape_of_array():
    points = np.random.default_rng(0).normal(size=(4, 2, 3))
    flat = distance_to_segment(points.reshape(8, 3), *np.eye(3)[:2])
    found = distance_to_segment(points, *np.eye(3)[:2])
    np.testing.assert_array_equal(found, flat.reshape(4, 2))
    np.testing.assert_array_equal(
        distance_to_segment(points[0], *np.eye(3)[:2]), flat[:2]
    )
