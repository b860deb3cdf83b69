"""Policies of tasks with objects: what they are told, and the door in the loop."""

import copy
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs import export
from envs.door import HANDLE
from envs.told import fixtures_program, observe_program
from rmp_mjx import deploy
from rmp_mjx.deploy import pilot
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.sim.robot import MujocoBackend

STEPS = 30
"""Policy steps in which the door is pulled open, and a little more."""


@pytest.fixture(scope="module")
def file(root, tmp_path_factory):
    """The door's policy for the Jaco 2, with control at the period of its task."""
    found = tmp_path_factory.mktemp("objects") / "door.rmp"
    run = str(root / "pretrained/door-rmp_vices")
    assert export.main([run, "--period", "0.005", "--out", str(found)]) == 0
    return deploy.load(found)


@pytest.fixture(scope="module")
def door():
    env = envs.load("door", physics="mujoco")
    state = jax.jit(env.reset)(jax.random.key(3))
    return SimpleNamespace(env=env, state=state)


@pytest.fixture
def world(file, door):
    """The door and its arm in MuJoCo at that start, and a source of obstacles."""
    model = copy.copy(door.env.scene.model)
    data = mujoco.MjData(model)
    data.qpos[:] = door.state.data.qpos
    mujoco.mj_forward(model, data)
    source = deploy.ObstacleSource(file.obstacles(), clock=lambda: data.time)
    source.put("planes", point=[[0.0, 0.0, -0.112]], normal=[[0.0, 0.0, 1.0]])
    objects = deploy.Objects(file, source, clock=lambda: data.time)
    return SimpleNamespace(model=model, data=data, source=source, objects=objects)


def measured(world):
    """What a camera and a force sensor would say of the door."""
    model, data = world.model, world.data
    handle, force = {model.geom(name).id for name in HANDLE}, np.zeros(6)
    grip = 0.0
    for k, contact in enumerate(data.contact):
        if handle & {contact.geom1, contact.geom2}:
            mujoco.mj_contactForce(model, data, k, force)
            grip += force[0]
    return {"hinge": data.qpos[7], "hinge_rate": data.qvel[7], "grip_force": grip}


def test_the_policy_opens_the_door_in_the_loop_as_in_its_environment(
    file, door, world, monkeypatch
):
    """Without the ramp of the start, the two differ by the first tick's torque.

    0.03 rad of 1.04, at every policy step: a tick of 5 ms at the door's greatest speed,
    4 rad/s, and what the contacts make of it; measured 0.01.
    """
    monkeypatch.setattr(pilot, "RAMP", 1e-9)
    step, state, own = jax.jit(door.env.step), door.state, []
    for _ in range(STEPS):
        own.append(float(state.data.qpos[7]))
        state = step(state, file.numpy_policy(np.asarray(state.obs)))
    arm, path = MujocoBackend(world.model, world.data, 7, period=0.005), []

    def write(tau):
        path.append(world.data.qpos[7])
        arm.write(tau)
        world.objects.put(**measured(world))

    world.objects.put(**measured(world))
    loop = deploy.Loop(
        file,
        deploy.CallbackBackend(arm.read, write, pace="simulation"),
        deploy.PolicyTargets(file, world.objects),
        world.source,
    )
    report = loop.run(0.05 * STEPS)
    assert report.reason is None and report.held
    assert own[0] == 0.0 and own[-1] > 0.99
    np.testing.assert_allclose(path[: 10 * STEPS : 10], own, atol=0.03)


@pytest.mark.parametrize("task", ["door", "push"])
def test_what_is_told_makes_the_environments_observation_and_obstacles(task, door):
    """Same operations in float32: 1e-6."""
    env, state = door.env, door.state
    if task == "push":
        env = envs.load("push", physics="mujoco")
        state = jax.jit(env.reset)(jax.random.key(3))
    rates = jnp.linspace(-0.5, 0.5, env.scene.model.nv)
    data = state.data.replace(qvel=rates)
    joints = {
        "door": {"hinge": data.qpos[7], "hinge_rate": rates[7]},
        "push": {"block": data.qpos[7:], "block_rate": rates[7:]},
    }[task]
    told = {"door": {"grip_force", *joints}, "push": {"block", "goal"}}[task]
    found, boxes = observe_program(env, {}), fixtures_program(env)
    assert found is not None and boxes is not None
    assert set(found[1][2]) == told and set(boxes[1][0]) == set(joints)
    known = {k: x for k, x in (joints | state.task).items() if k in told}
    site = env.site(data)
    none = Obstacles.empty().spheres
    values = env.observe(data, site, state.task)
    wanted = env.assemble(site, data.qpos[:7], values, lambda: none)
    seen = found[0](data.qpos[:7], rates[:7], known, {})
    np.testing.assert_allclose(seen, wanted, atol=1e-6)
    slots = env.fixtures(Obstacles.empty(**env.fixture_slots), data).boxes
    for name, value in boxes[0](joints)["boxes"].items():
        np.testing.assert_allclose(value, getattr(slots, name), atol=1e-6)


def test_an_observation_of_more_than_joints_is_left_to_the_caller(door, monkeypatch):
    def observe(data, site, task):
        return {"handle": data.mocap_pos.sum()}

    def assemble(site, q, values, spheres):
        return values["handle"]

    monkeypatch.setattr(door.env, "observe", observe)
    monkeypatch.setattr(door.env, "assemble", assemble)
    assert observe_program(door.env, {}) is None


def test_a_file_without_an_observation_says_what_to_do(file, world):
    bare = copy.copy(file)
    bare.programs = {k: v for k, v in file.programs.items() if k != "observe"}
    message = "task 'door' takes more .* make it yourself"
    with pytest.raises(ValueError, match=message):
        deploy.PolicyTargets(bare, world.objects)
    with pytest.raises(ValueError, match=message):
        deploy.Objects(bare, world.source)


def test_objects_that_nobody_reports_any_more_stop_the_arm(file, world):
    """Silent from 0.6 s on, and stale 0.25 s later; policy steps come 0.05 s apart."""
    arm = MujocoBackend(world.model, world.data, 7, period=0.005)

    def write(tau):
        arm.write(tau)
        world.source.fresh()
        if world.data.time < 0.6:
            world.objects.put(**measured(world))

    backend = deploy.CallbackBackend(arm.read, write, pace="simulation")
    targets = deploy.PolicyTargets(file, world.objects)
    with pytest.raises(ValueError, match="nothing is known of the objects"):
        deploy.Loop(file, backend, targets, world.source).run(2.0)
    assert world.data.time == 0.0
    world.objects.put(**measured(world))
    report = deploy.Loop(file, backend, targets, world.source).run(2.0)
    assert report.held and "objects stale: " in str(report.reason)
    assert 0.85 <= world.data.time - 0.5 <= 0.9 + 1.0  # held for 0.5, braked for 1 s


def test_objects_that_cannot_be_are_refused(world):
    objects, good = world.objects, {"hinge": 0.1, "hinge_rate": 0.0, "grip_force": 5.0}
    assert objects.names == dict.fromkeys(good, ())
    objects.put(stamp=0.0, **good)
    told = objects.told(np.zeros(3), 0.0)
    assert {k: float(x) for k, x in told.items()} == pytest.approx(good, rel=1e-6)
    boxes = world.source.get().slots["boxes"]
    assert boxes["active"].all() and boxes["hand_may_touch"].tolist() == [False, True]
    for change, message in (
        ({"handle": 1.0}, "give .*hinge"),
        ({"hinge": np.zeros(2)}, r"hinge must have shape \(\)"),
        ({"hinge": np.nan}, "hinge must be finite"),
    ):
        with pytest.raises(ValueError, match=message):
            objects.put(**(good | change))
