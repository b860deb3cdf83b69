"""Controllers as dials, and back."""

import numpy as np
import pytest

from rmp_mjx.viewer.dials import CONTROLLERS, as_python, dials, make, named, turned


@pytest.mark.parametrize("name", list(CONTROLLERS))
def test_turning_dials_gives_the_controller_with_these_parameters(jaco, name):
    controller = make(name, jaco, 0.005)
    before = dials(controller)
    assert dials(turned(controller, before)) == before
    path = next(iter(before))
    after = dials(turned(controller, {path: before[path] + 1.0}))
    assert after == before | {path: before[path] + 1.0}
    assert named(controller, np.array([*before.values()])) == before


def test_every_number_of_the_leaves_has_a_dial(jaco):
    found = dials(make("rmp_vices", jaco, 0.005))
    wanted = {"leaves.collision.mu", "leaves.joint_limit.barrier.margin"}
    assert wanted | {"leaves.posture.kq", "attractor_weight"} <= set(found)
    assert not any(path.startswith(("robot", "action_range")) for path in found)


@pytest.mark.parametrize("name", list(CONTROLLERS))
def test_the_python_makes_the_same_controller(name, jaco):
    before = dials(make(name, jaco, 0.005))
    changed = {path: 2.0 * value + 0.25 for path, value in before.items()}
    scope: dict = {}
    exec(as_python(name, "jaco2", changed), scope)
    assert dials(scope["controller"]) == changed
    exec(as_python(name, "jaco2", {}), scope)
    assert dials(scope["controller"]) == before
