"""MuJoCo Warp: what needs it is skipped without the extra; the rest always runs."""

import importlib
import importlib.util

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rmp_mjx import sim
from rmp_mjx.sim import PhysicsError, load_physics, read_contacts
from rmp_mjx.sim.warp import _flattened, capacity

WARP = importlib.util.find_spec("warp") is not None
with_warp = pytest.mark.skipif(
    not WARP, reason="warp-lang is not installed (extra 'warp')"
)


@pytest.mark.parametrize("ask", [sim.require, lambda n: load_physics(n, None)])
def test_without_the_package_the_error_says_how_to_get_it(monkeypatch, ask):
    find = importlib.util.find_spec
    missing = lambda name, *rest: None if name == "warp" else find(name, *rest)  # noqa: E731
    monkeypatch.setattr(importlib.util, "find_spec", missing)
    with pytest.raises(PhysicsError, match=r"warp-lang.*rmp-mjx\[warp\]"):
        ask("warp")


@pytest.mark.parametrize("script", ["train", "eval"])
def test_the_entry_points_end_with_exit_code_2(monkeypatch, capsys, tmp_path, script):
    find = importlib.util.find_spec
    missing = lambda name, *rest: None if name == "warp" else find(name, *rest)  # noqa: E731
    monkeypatch.setattr(importlib.util, "find_spec", missing)
    out = {"train": "--run-dir", "eval": "--out"}[script]
    args = ["--physics", "warp", out, str(tmp_path / "new")]
    args += {"train": [], "eval": ["--agent", "random"]}[script]
    assert importlib.import_module(script).main(args) == 2
    assert "rmp-mjx[warp]" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_an_unknown_engine_is_refused_by_name():
    with pytest.raises(PhysicsError, match=r"'bullet'.*auto, mujoco, mjx, warp"):
        sim.require("bullet")


def test_each_vmap_goes_into_the_leading_axis():
    shapes = []

    def double(x, y):
        shapes.append((x["a"].shape, y.shape))
        return {"out": 2.0 * x["a"] + y[:, :1]}

    function = _flattened(double)
    x = jnp.arange(2.0 * 3 * 1 * 5).reshape(2, 3, 1, 5)
    y = jnp.arange(3.0).reshape(3, 1, 1)
    nested = jax.vmap(jax.vmap(function), in_axes=(0, None))
    out = nested({"a": x}, y)["out"]
    np.testing.assert_array_equal(out, 2.0 * x + y)
    assert shapes[-1] == ((6, 5), (6, 1))  # 2 x 3 worlds at once


def test_arrays_without_entries_pass_a_vmap():
    """A scene without spheres has no mocap bodies."""
    function = _flattened(lambda x, empty: (x + 1.0, empty))
    x, empty = jnp.zeros((2, 3, 1, 5)), jnp.zeros((2, 3, 1, 0, 3))
    out, still = jax.vmap(jax.vmap(function))(x, empty)
    np.testing.assert_array_equal(out, x + 1.0)
    assert still.shape == empty.shape


def test_there_is_room_for_every_contact(weights, jaco):
    # A rod touches the floor at two points, a ball anything at one; frictionless.
    contacts, rows = capacity(weights)
    assert contacts == 2 + 1 + 1
    assert rows >= contacts + 2 * weights.njnt
    model = jaco.scene.model
    data = mujoco.MjData(model)
    assert capacity(model)[0] >= model.npair
    for q in jaco.q:
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        assert data.ncon <= capacity(model)[0] and data.nefc <= capacity(model)[1]


@pytest.fixture(scope="module")
def engine(weights):
    return load_physics("warp", weights)


@pytest.fixture(scope="module")
def start(engine):
    q = jnp.array([[0.0, 0.0], [0.1, 0.2], [-0.001, 0.3], [0.2, -0.002]])
    return jax.vmap(engine.init)(q, jnp.zeros((4, 2)))


FORCE = jnp.array([[0.0, 0.0], [-5.0, 3.0], [1.0, 2.0], [0.0, -4.0]])


@with_warp
def test_nested_vmap_is_one_batch_and_a_loop(engine, start):
    flat = jax.jit(jax.vmap(engine.step))(start, FORCE)
    fold = lambda x: x.reshape(2, 2, *x.shape[1:])  # noqa: E731
    nested = jax.jit(jax.vmap(jax.vmap(engine.step)))(
        jax.tree.map(fold, start), fold(FORCE)
    )
    # The order of a sum on a GPU is not fixed: float32 rounding of forces of 100 N.
    close = lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5, rtol=1e-5)  # noqa: E731
    jax.tree.map(close, jax.tree.map(fold, flat), nested)
    one = jax.jit(engine.step)(jax.tree.map(lambda x: x[2], start), FORCE[2])
    jax.tree.map(lambda a, b: close(a[2], b), flat, one)


@with_warp
def test_one_step_agrees_with_c(engine, start, weights):
    """Positions to float32; contact forces within 1 %, or 0.05 N."""
    c = load_physics("mujoco", weights)
    ours, true = (jax.jit(jax.vmap(e.step))(start, FORCE) for e in (engine, c))
    np.testing.assert_allclose(ours.qpos, true.qpos, atol=1e-6)
    np.testing.assert_allclose(ours.qvel, true.qvel, atol=1e-3)
    mine, theirs = (
        jax.vmap(lambda s: read_contacts(weights, s))(x) for x in (ours, true)
    )
    np.testing.assert_array_equal(mine.touching, theirs.touching)
    assert np.any(theirs.touching) and not np.any(mine.overflow)
    np.testing.assert_allclose(mine.force, theirs.force, rtol=0.01, atol=0.05)


@with_warp
def test_a_bad_world_comes_back_as_nan_and_alone(engine, start):
    state = start.replace(qpos=start.qpos.at[1, 0].set(jnp.nan))
    after = jax.jit(jax.vmap(engine.step))(state, FORCE)
    assert np.any(np.isnan(after.qvel[1]))
    assert np.all(np.isfinite(np.asarray(after.qpos)[[0, 2, 3]]))


@with_warp
def test_the_state_keeps_its_types(engine, start):
    after = jax.jit(jax.vmap(engine.step))(start, FORCE)
    describe = lambda s: jax.tree.map(lambda x: (x.shape, x.dtype), s)  # noqa: E731
    assert describe(after) == describe(start)


@with_warp
@pytest.mark.slow
def test_free_motion_and_collisions_of_the_arm_agree_with_c(jaco):
    """Free motion over 0.5 s within 1e-4 rad; first contact at most a step apart.

    Slow on a CPU, where Warp compiles its kernels for minutes.
    """
    model = jaco.scene.model
    found = {}
    for name in ("mujoco", "warp"):
        engine = load_physics(name, model)
        q = jnp.asarray(jaco.q, jnp.float32)
        mocap = jnp.asarray(jaco.mocap, jnp.float32)
        state = jax.vmap(engine.init)(q, jnp.zeros_like(q), mocap)
        step, states, touching = jax.jit(jax.vmap(engine.step)), [], []
        for k in range(100):
            state = step(state, jnp.asarray(jaco.torque(k), jnp.float32))
            states.append(np.asarray(state.qpos))
            contacts = jax.vmap(lambda s: read_contacts(model, s))(state)
            touching.append(np.asarray(contacts.touching.any(-1)))
        found[name] = np.stack(states), np.stack(touching)
    (ours, mine), (true, theirs) = found["warp"], found["mujoco"]
    np.testing.assert_allclose(ours[:, 0], true[:, 0], atol=1e-4)
    for lane in (1, 2, 3):
        assert theirs[:, lane].any()
        assert abs(int(mine[:, lane].argmax()) - int(theirs[:, lane].argmax())) <= 1
