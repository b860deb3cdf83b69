"""Fitted capsules contain the whole hull, with little to spare."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from rmp_mjx.robot.enclose import (
    THICK,
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
