"""A task's objects in the live view."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from rmp_mjx.math import quat_to_mat
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.viewer import physics
from rmp_mjx.viewer.session import PERIOD, Session
from tests.viewer import chromium

pytest.importorskip("viser", reason="the extra viewer is not installed")

from envs import live
from rmp_mjx.viewer.__main__ import main
from rmp_mjx.viewer.page import Page


@pytest.fixture(scope="module")
def door():
    return live.scene("door", "jaco2")


@pytest.mark.parametrize("task", ["door", "push"])
def test_the_controllers_see_the_objects_as_in_the_task(task):
    robot, objects = live.scene(task, "jaco2")
    model = physics.build(robot, PERIOD, objects)
    env = envs.load(task)
    data, n = mujoco.MjData(model), robot.n
    data.qpos[:] = [*robot.q_home, *objects.qpos]
    rng = np.random.default_rng(0)
    data.qpos[n : n + 3] += 0.4  # the door's angle, or the block's place
    data.qvel[n:] = rng.uniform(-1.0, 1.0, model.nv - n)
    seen = objects.read(model, data)[0]
    wanted = env.fixtures(Obstacles.empty(boxes=2), data).boxes
    # float32 of lengths and velocities of about 1
    assert np.allclose(seen.position, wanted.center[0], atol=1e-6)
    assert np.allclose(seen.size, wanted.half_size[0], atol=1e-6)
    assert np.allclose(quat_to_mat(jnp.array(seen.wxyz)), wanted.rotation[0], atol=1e-6)
    assert np.allclose(seen.velocity, wanted.velocity[0], atol=1e-6)
    assert np.allclose(seen.spin, wanted.angular_velocity[0], atol=1e-6)
    assert seen.hand_may_touch == bool(wanted.hand_may_touch[0])


def test_a_target_that_is_dragged_opens_the_door(door, tmp_path):
    session = Session(door[0], ["rmp_vices"], "free", door[1])
    assert session.floor == door[1].floor
    position, wxyz = session.target
    session.target = position - np.array([0.12, 0.03, 0.0]), wxyz
    frames = [session.step() for _ in range(400)]
    angles = [float(frame.arms[0].rest[0][0]) for frame in frames]
    felt = max(float(np.abs(frame.arms[0].tau_ext).max()) for frame in frames)
    assert angles[0] < 0.01 and angles[-1] > 0.1
    assert felt > 0.5  # the handle is pulled [N m], which is no hit
    assert max(frame.arms[0].force for frame in frames) == 0.0
    assert "collision" in session.think(frames[-1]).asked

    session.restore(frames[199])
    assert session.arms[0].qpos[session.robot.n] == angles[199]

    page = Page(session, "jaco2", port=8760, show="capsules", folder=tmp_path)
    with chromium.running(page):
        page.order(lambda: session.drive(["rmp_vices", "vices"]))
        chromium.wait(lambda: page.pictures > 2 and len(page._arms) == 2, "pictures")


def test_a_scene_that_is_none_is_refused_with_the_names(capsys):
    assert main(["--scene", "doors"]) == 2
    told = capsys.readouterr().err
    assert "door" in told and "gate" in told
