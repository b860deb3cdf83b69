"""What leaves for the robot is what was trained."""

import json
import re
import subprocess
import sys
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest

import envs
from envs.deployment import controller_of
from rmp_mjx import deploy
from rmp_mjx.deploy.artefact import METADATA, VERSION, write
from rmp_mjx.deploy.artefact import read as read_parts
from rmp_mjx.deploy.programs import control_programs, serialise
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.training.config import ConfigError

STATES = 10_000


@pytest.fixture(scope="module")
def states(deployed):
    """Joint states over the whole range, actions, a sphere that may be near, memory."""
    rng, limits = np.random.default_rng(0), deployed.limits
    span = limits.q_upper - limits.q_lower
    q = limits.q_lower + span * rng.uniform(0.02, 0.98, (STATES, 7))
    qd = limits.qd * rng.uniform(-0.5, 0.5, (STATES, 7))
    action = rng.uniform(-1, 1, (STATES, 12))
    center = rng.uniform([0.2, -0.4, 0.0], [0.7, 0.4, 0.6], (STATES, 3))
    time = rng.uniform(0, 20, STATES)
    last = limits.tau * rng.uniform(-0.8, 0.8, (STATES, 7))
    return [np.asarray(x, np.float32) for x in (q, qd, action, center, time, last)]


def test_torques_are_those_of_the_trained_controller(deployed, trained, states):
    """On 10,000 states, half of them free to take any torque, half bound by the rate.

    Both run the same operations in float32, which XLA may fuse in another way: 1e-5 of
    the torque limit. Near singular postures the controller magnifies the rounding, and
    where two sets of limits are as good, the root may stop at either: 1 in 100 states
    may differ by more (measured: 0.4), 1 in 1,000 by more than 1e-3 (measured: 0.01 %).
    """
    q, qd, action, center, time, _ = states
    ctrl = trained.controller

    def own(q, qd, action, center, time, last):
        slots = Obstacles.empty(spheres=4, planes=1).with_spheres(
            center[None], jnp.array([0.05])
        )
        slots = slots.with_planes(
            jnp.array([[0.0, 0.0, -0.112]]), jnp.array([[0.0, 0.0, 1.0]])
        )
        target = ctrl.setpoint(q, ctrl.decode(action), time)
        free = ctrl(q, qd, target, slots, jnp.zeros(7)).tau
        last = jnp.where(time < 10.0, free, last)
        return ctrl(q, qd, target, slots, jnp.zeros(7), last).tau, last

    program = jax.jit(lambda *a: jax.lax.map(lambda one: own(*one), a))
    wanted, last = program(*states)

    def batch(x):
        return np.broadcast_to(x, (STATES, *np.shape(x))).copy()

    obstacles = jax.tree.map(batch, deployed.obstacles())
    obstacles["spheres"]["center"][:, 0] = center
    obstacles["spheres"]["radius"][:, 0] = 0.05
    obstacles["spheres"]["active"][:, 0] = True
    obstacles["planes"]["point"][:] = [0.0, 0.0, -0.112]
    obstacles["planes"]["normal"][:] = [0.0, 0.0, 1.0]
    obstacles["planes"]["active"][:] = True
    memory = jax.tree.map(batch, deployed.memory()) | {"tau": np.asarray(last)}
    target = deployed.setpoint(q, action, time)
    found = deployed.control(q, qd, target, obstacles, memory)
    assert np.all(np.asarray(found["usable"]) == 1.0)
    error = np.abs(np.asarray(found["tau"]) - wanted) / deployed.limits.tau
    worst = np.max(error, axis=1)
    assert np.mean(worst > 1e-5) < 1e-2
    assert np.mean(worst > 1e-3) < 1e-3
    assert np.mean(np.max(np.abs(wanted - last), axis=1) > 0.1) > 0.3  # it was at work


def test_actions_and_observations_are_those_of_training(deployed, trained):
    """Same operations in float32: 1e-5."""
    env = trained.env
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), 50))
    q, qd = state.data.qpos[:, :7], state.data.qvel[:, :7]

    def batch(x):
        return np.broadcast_to(x, (50, *np.shape(x)))

    slots = jax.tree.map(batch, deployed.obstacles())
    seen = deployed.observe(q, qd, state.task, slots)
    np.testing.assert_allclose(seen, state.obs, atol=1e-5)
    wanted = trained.agent(state.obs, trained.key)
    np.testing.assert_allclose(deployed.policy(state.obs), wanted, atol=1e-5)
    assert np.std(wanted) > 0.1


def test_numpy_and_onnx_have_the_same_policy(exported, trained):
    """The layers' sums in another order: 1e-5."""
    obs = np.random.default_rng(0).normal(size=(1000, 34)).astype(np.float32)
    wanted = trained.agent(obs, trained.key)
    np.testing.assert_allclose(
        deploy.NumpyPolicy.load(exported)(obs), wanted, atol=1e-5
    )
    session = onnxruntime.InferenceSession(read_parts(exported)[1]["policy.onnx"])
    (found,) = session.run(["action"], {"observation": obs})
    np.testing.assert_allclose(np.asarray(found), wanted, atol=1e-5)


def test_a_file_says_what_it_is(deployed):
    assert deployed.robot == "fr3"
    assert (deployed.period, deployed.policy_period) == (0.001, 0.05)
    for program in deployed.programs.values():
        assert set(program.platforms) == {"cpu", "cuda"}
    card = deployed.card
    assert "| ended in a collision of arm or hand | 0.0 | 0.0 to 3.6 |" in card
    assert "The figures are of the arm 'panda', not of 'fr3'." in card
    assert "control every 5 ms" in card and "a contact may find the arm" in card


def test_loading_needs_neither_mujoco_nor_flax_nor_brax(exported, root):
    code = f"""
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {{"mujoco", "flax", "brax", "jaxtyping", "polars"}}:
            raise ImportError(name + " is blocked")
sys.meta_path.insert(0, Blocked())
import numpy as np
from rmp_mjx import deploy
found = deploy.load({str(exported)!r})
q = found.start[None]
p = found.grip(q, 0 * q)["p"]
print(float(p[0, 0]), deploy.NumpyPolicy.load({str(exported)!r})(np.zeros(34)).shape)
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert re.match(r"0\.\d+ \(12,\)", done.stdout)


@pytest.fixture
def parts(exported):
    metadata, found = read_parts(exported)
    for name in ("format", "version", "sha256"):
        metadata.pop(name)
    return metadata, found


def test_damaged_and_foreign_files_are_refused_with_a_reason(exported, tmp_path, parts):
    whole = exported.read_bytes()
    rng = np.random.default_rng(0)
    path = tmp_path / "x.rmp"
    for place in rng.integers(0, len(whole), 40):
        path.write_bytes(whole[:place])
        with pytest.raises(deploy.DeployError, match="damaged"):
            deploy.load(path)
    _, sound = read_parts(exported)
    for place in rng.integers(0, len(whole), 40):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        try:
            _, found = read_parts(path)
        except deploy.DeployError:
            continue
        assert found == sound  # the bit was one that nobody reads, a date say
    for text in (b"", b"PK", b"\x80\x04.", whole[:4] + b"\0" * 99):
        path.write_bytes(text)
        with pytest.raises(deploy.DeployError, match="no file of rmp-mjx-export"):
            deploy.load(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(METADATA, json.dumps({"format": "other"}))
    with pytest.raises(ValueError, match="another format"):
        deploy.load(path)
    with pytest.raises(FileNotFoundError):
        deploy.load(tmp_path / "none.rmp")


def test_files_with_a_part_too_few_or_of_another_version_are_refused(tmp_path, parts):
    metadata, found = parts
    path = tmp_path / "x.rmp"
    write(path, metadata, {k: v for k, v in found.items() if k != "control.stablehlo"})
    with pytest.raises(deploy.DeployError, match="no program control"):
        deploy.load(path)
    write(path, {k: v for k, v in metadata.items() if k != "robot"}, found)
    with pytest.raises(deploy.DeployError, match="'robot'"):
        deploy.load(path)
    write(path, metadata | {"version": VERSION + 1}, found)
    with pytest.raises(deploy.DeployError, match="version 2 of the format"):
        deploy.load(path)
    write(path, metadata, found | {"grip.stablehlo": b"not StableHLO"})
    with pytest.raises(deploy.DeployError, match="cannot be read by jax"):
        deploy.load(path)


def test_a_part_that_is_not_what_the_metadata_says_is_refused(tmp_path, exported):
    path = tmp_path / "x.rmp"
    with zipfile.ZipFile(exported) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            new.writestr(name, data + b" " if name == "card.md" else data)
    with pytest.raises(deploy.DeployError, match=r"card\.md fails its checksum"):
        deploy.load(path)


def test_the_same_policy_makes_the_same_bytes(tmp_path, exported, parts):
    write(tmp_path / "x.rmp", *parts)
    assert (tmp_path / "x.rmp").read_bytes() == exported.read_bytes()


def test_a_guard_goes_along_at_the_period_of_the_loop():
    """Same operations in float32, as above; near a sphere the guard is at work."""
    env = envs.load("trajectory", physics="mujoco", guard=True)
    ctrl, slots = controller_of(env, 0.001), Obstacles.empty(spheres=1)
    assert ctrl.guard is not None and ctrl.guard.step == ctrl.period == 0.001
    program = control_programs(ctrl, None, slots)["control"]
    exported = jax.export.deserialize(bytearray(serialise(program)))
    rng, number = np.random.default_rng(0), 50
    q = env.robot.q_home + rng.normal(0.0, 0.3, (number, 7)).astype(np.float32)
    qd = rng.normal(0.0, 0.3, (number, 7)).astype(np.float32)
    away = rng.normal(0.0, 0.1, (number, 3)).astype(np.float32)

    @jax.jit
    @jax.vmap
    def own(q, qd, away):
        target = ctrl.setpoint(q, ctrl.decode(jnp.zeros(12)), 0.0)
        center = target.p_des + away
        world = slots.with_spheres(center[None], jnp.array([0.05]))
        out = ctrl(q, qd, target, world, None, jnp.zeros(7))
        return out.tau, out.diagnostics["guard_used"], target, center

    wanted, used, target, center = own(q, qd, away)
    arguments = jax.tree.map(
        lambda x: np.zeros((number, *x.shape), x.dtype), program[1]
    )
    spheres = arguments[3]["spheres"]
    spheres["center"][:, 0], spheres["radius"][:], spheres["active"][:] = (
        center,
        0.05,
        1,
    )
    fields = {name: vars(target)[name] for name in arguments[2]}
    found = exported.call(q, qd, fields, *arguments[3:])["tau"]
    limit = np.asarray(env.robot.tau_max)
    np.testing.assert_allclose(found / limit, wanted / limit, atol=1e-4)
    assert 0.1 < np.mean(np.asarray(used) > 0.0) < 1.0


def test_a_guard_is_refused_where_its_stop_may_come_too_slowly():
    env = envs.load("trajectory", robot="fr3", physics="mujoco", guard=True)
    with pytest.raises(ConfigError, match="'fr3' limits its rate: export without"):
        controller_of(env, 0.001)
