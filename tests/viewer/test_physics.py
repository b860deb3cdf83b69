"""The arm among things, in MuJoCo."""

import mujoco
import numpy as np
import pytest

from rmp_mjx.viewer import physics
from rmp_mjx.viewer.objects import NONE
from rmp_mjx.viewer.things import Thing


@pytest.fixture(scope="module")
def model(jaco):
    return physics.build(jaco, 0.005, NONE)


def at_home(model, robot, things, floor):
    data = mujoco.MjData(model)
    physics.resize(model, things, floor)
    physics.place(model, data, things)
    data.qpos[:] = robot.q_home
    mujoco.mj_forward(model, data)
    return data


def test_the_floor_is_in_the_arms_way_only_where_it_is(model, jaco):
    hand = at_home(model, jaco, (), None).site(jaco.site_name).xpos[2]
    for floor, hit in ((None, False), (0.0, False), (hand + 0.05, True)):
        data = at_home(model, jaco, (), floor)
        assert (data.ncon > 0) == hit == (physics.contact_force(model, data) > 0.0)
        assert np.any(physics.contact_torque(model, data)) == hit


def test_what_the_hand_may_touch_is_no_hit(model, jaco):
    hand = at_home(model, jaco, (), None).site(jaco.site_name).xpos
    data = at_home(model, jaco, (Thing("sphere", tuple(hand), (0.05,)),), None)
    work = frozenset({int(model.geom("thing/sphere0").id)})
    assert physics.contact_force(model, data) > 0.0
    assert physics.contact_force(model, data, work) == 0.0
