"""Which leaves the tree of RMP-VICES has."""

import pytest

from rmp_mjx import RMPVICES, Leaves
from rmp_mjx.rmp.leaves import collision_near, collision_transit
from rmp_mjx.shapes import KINDS


def test_a_controller_has_the_default_leaves_unless_it_is_given_others(robot):
    assert RMPVICES(robot) == RMPVICES(robot, Leaves.default(robot))
    assert RMPVICES(robot, Leaves()).leaves == Leaves()
    assert RMPVICES(robot, Leaves()) != RMPVICES(robot)


def test_one_kind_of_obstacle_gets_its_own_leaf_and_the_others_keep_theirs(robot):
    ctrl = RMPVICES(robot).with_collision({"spheres": collision_transit()})
    ctrl = ctrl.with_collision({"boxes": None})
    assert ctrl.leaves.collision == {
        "spheres": collision_transit(),
        "planes": collision_near(),
        "capsules": collision_near(),
        "boxes": None,
    }
    assert ctrl.leaves.self_collision == RMPVICES(robot).leaves.self_collision
    assert ctrl.with_collision(None).leaves.collision is None


def test_a_leaf_for_each_kind_must_be_complete():
    with pytest.raises(ValueError, match="no leaf for planes, capsules, boxes"):
        Leaves(collision={"spheres": collision_near()})
    Leaves(collision=dict.fromkeys(KINDS.values()))
