"""Placement rules of both layouts, recomputed in NumPy on 1,000 episodes."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs.placement import place_spheres, sample_apart
from envs.trajectory import BOX_HIGH, BOX_LOW

RADIUS = 0.05
ROUNDING = 1e-5  # float32 positions of order 1 m


def distances(a, b):
    return np.linalg.norm(a[:, :, None] - b[:, None], axis=-1)


@pytest.fixture(params=["far", "close"])
def layout(request):
    task = request.getfixturevalue(request.param)
    starts = task.starts
    placed = np.asarray(starts.info["spheres"].placed)
    points = np.asarray(starts.task["points"], float)
    centers = np.asarray(starts.data.mocap_pos, float)
    return request.param, task, points, centers, placed, np.asarray(starts.data.qpos)


def test_via_points_are_in_their_box_and_apart(layout):
    _, _, points, *_ = layout
    assert np.all(points >= BOX_LOW - ROUNDING) and np.all(
        points <= BOX_HIGH + ROUNDING
    )
    between = distances(points, points) + 9 * np.eye(4)
    assert np.min(between) >= 0.10 - ROUNDING
    # The whole box is in use: the gap rule does not push the points into corners.
    assert np.all(np.ptp(points.reshape(-1, 3), axis=0) > 0.95 * (BOX_HIGH - BOX_LOW))


def test_spheres_keep_the_layouts_clearance_of_the_via_points(layout):
    name, _, points, centers, placed, _ = layout
    nearest = distances(centers, points).min(axis=-1)[placed]
    assert nearest.min() >= 0.08 + (RADIUS if name == "far" else 0.0) - ROUNDING


def test_spheres_keep_the_layouts_clearance_of_the_arm(layout, arm):
    """Against MuJoCo's own capsule distance, not the control points of the arm.

    0.5 mm of tolerance: the points' spheres leave a scallop between them.
    """
    name, task, _, centers, placed, q = layout
    model, data = task.env.scene.model, arm.data
    links = [g for g in range(model.ngeom) if model.geom(g).name.startswith("arm/")]
    links = [g for g in links if model.geom(g).name != "arm/base"]
    nearest = []
    for i in range(0, 1000, 5):
        data.qpos[:], data.mocap_pos[:] = q[i], centers[i]
        mujoco.mj_kinematics(model, data)
        for k in np.flatnonzero(placed[i]):
            ball = model.geom(f"sphere_{k}").id
            nearest.append(
                min(
                    mujoco.mj_geomDistance(model, data, g, ball, 1.0, None)
                    for g in links
                )
            )
    assert min(nearest) >= (0.08 if name == "far" else 0.03) - 5e-4


def test_nearly_all_spheres_find_a_place_and_the_others_wait_out_of_reach(layout):
    _, _, _, centers, placed, _ = layout
    assert np.mean(placed) > 0.98
    inside = (centers >= BOX_LOW - ROUNDING) & (centers <= BOX_HIGH + ROUNDING)
    assert np.all(inside[placed])
    assert np.all(centers[~placed] == [0.0, 0.0, -5.0])


def test_layouts_differ_as_their_names_say(far, close):
    """`close` spheres come nearer to the via points than `far` ones ever do."""
    nearest = [
        distances(
            np.asarray(t.starts.data.mocap_pos), np.asarray(t.starts.task["points"])
        )
        for t in (far, close)
    ]
    assert np.min(nearest[1]) < 0.13 - ROUNDING <= np.min(nearest[0])


def test_a_sphere_that_fits_nowhere_is_reported():
    low, high = BOX_LOW, BOX_HIGH
    points = jnp.array([0.5 * (low + high)])
    none = jnp.full((1, 3), 9.0), jnp.zeros(1)
    _, placed = place_spheres(
        jax.random.key(0), 3, 0.4, "far", low, high, points, *none
    )
    assert not np.any(placed)
    _, placed = place_spheres(
        jax.random.key(0), 3, 0.01, "close", low, high, points, *none
    )
    assert np.all(placed)


def test_points_that_cannot_be_apart_are_reported_and_spread():
    low, high = np.zeros(3), np.full(3, 0.1)
    points, good = sample_apart(jax.random.key(0), 4, low, high, gap=1.0)
    assert not good
    assert np.min(distances(points[None], points[None])[0] + np.eye(4)) > 0.03
