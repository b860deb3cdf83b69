"""Things in the arm's way."""

import dataclasses

import numpy as np
import pytest

from rmp_mjx.viewer.things import SCENES, SLOTS, SWING, Thing, obstacles

QUARTER_TURN = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)  # about y: z becomes x


def test_things_become_the_obstacles_of_the_controllers():
    things = [
        Thing("box", (1.0, 0.0, 0.0), (0.1, 0.2, 0.3), QUARTER_TURN),
        Thing("sphere", (0.0, 1.0, 0.0), (0.05,), velocity=(0.1, 0.0, 0.0)),
        Thing("capsule", (0.0, 0.0, 1.0), (0.04, 0.2), QUARTER_TURN),
    ]
    found = obstacles(things, floor=0.2)
    assert found.spheres.active.tolist() == [True] + [False] * (SLOTS["sphere"] - 1)
    assert np.allclose(found.spheres.velocity[0], [0.1, 0.0, 0.0])
    # float32 of exact numbers, within its rounding
    assert np.allclose(found.capsules.axis[0], [1.0, 0.0, 0.0], atol=1e-6)
    assert found.capsules.half_length[0] == np.float32(0.2)
    assert np.allclose(found.boxes.rotation[0][:, 2], [1.0, 0.0, 0.0], atol=1e-6)
    assert np.allclose(found.boxes.half_size[0], [0.1, 0.2, 0.3])
    assert found.planes.active[0] and found.planes.point[0, 2] == np.float32(0.2)
    assert all(slots.sound().all() for slots in vars(found).values())
    assert not obstacles(things, floor=None).planes.active[0]


def test_a_moving_thing_swings_about_its_place():
    thing = Thing("sphere", (0.0, 0.0, 0.0), (0.05,), velocity=(0.5, 0.0, 0.0))
    path = []
    for _ in range(600):
        thing = thing.moved(0.01)
        path.append(thing.position[0])
    # it may be one step of 5 mm beyond the end of its swing
    assert SWING < max(path) < SWING + 0.0051 and -SWING - 0.0051 < min(path) < -SWING
    still = Thing("sphere", (0.1, 0.0, 0.0), (0.05,))
    assert still.moved(1.0) is still


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"kind": "cone"}, "kind must be one of"),
        ({"size": (0.0,)}, "1 positive sizes"),
        ({"size": (0.1, 0.1)}, "1 positive sizes"),
        ({"position": (np.nan, 0.0, 0.0)}, "position must be finite"),
    ],
)
def test_numbers_that_mean_no_thing_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        dataclasses.replace(Thing("sphere", (0.0, 0.0, 0.0), (0.1,)), **change)


def test_every_scene_fits_into_the_slots():
    for things in SCENES.values():
        for kind, slots in SLOTS.items():
            assert sum(thing.kind == kind for thing in things) <= slots
