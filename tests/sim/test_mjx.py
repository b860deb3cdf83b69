"""MJX against MuJoCo C: free motion, and the force of scripted collisions."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx.sim import load_physics, read_contacts

STEPS = 200
LANES = 32


@pytest.fixture(scope="module")
def c_step(jaco):
    return jax.jit(jax.vmap(load_physics("mujoco", jaco.scene.model).step))


@pytest.fixture(scope="module")
def mjx_step(jaco):
    """One program of one shape for all tests here: MJX compiles slowly."""
    return jax.jit(jax.vmap(load_physics("mjx", jaco.scene.model).step))


def start(jaco, size):
    engine = load_physics("mujoco", jaco.scene.model)
    q, mocap = jnp.asarray(jaco.q), jnp.asarray(jaco.mocap)
    state = jax.vmap(engine.init)(q, jnp.zeros_like(q), mocap)
    state = state.replace(model=models(jaco.scene.model))
    lanes = np.arange(size) % 4
    return jax.tree.map(lambda x: x[lanes], state)


def models(model):
    """Each motion's own masses and friction; only the free motion's differ."""
    light, damped = np.ones((4, model.nbody)), np.zeros((4, model.nv))
    light[0], damped[0] = 0.95, 2.0
    return {
        "body_mass": jnp.asarray(light * model.body_mass, jnp.float32),
        "dof_damping": jnp.asarray(damped + model.dof_damping, jnp.float32),
    }


@pytest.fixture(scope="module")
def history(jaco, c_step):
    """States and torques of the scripted motions in C, (steps, 4, ...)."""
    state, states, torques = start(jaco, 4), [], []
    for k in range(STEPS):
        torques.append(jnp.asarray(jaco.torque(k), jnp.float32))
        states.append(state)
        state = c_step(state, torques[-1])
    stack = jax.tree.map(lambda *x: jnp.stack(x), *states)
    return stack, jnp.stack(torques), state


def test_free_motion_of_one_second_agrees_with_c(jaco, mjx_step, history):
    """Within 1e-4 rad and 1e-3 rad/s: float32 dynamics against float64, 200 steps."""
    state = start(jaco, LANES)
    for torque in history[1]:
        state = mjx_step(state, torque[np.arange(LANES) % 4])
    moved = np.abs(history[2].qpos[0] - jaco.q[0])
    assert np.max(moved) > 0.2
    np.testing.assert_allclose(state.qpos[0], history[2].qpos[0], atol=1e-4)
    np.testing.assert_allclose(state.qvel[0], history[2].qvel[0], atol=1e-3)


def test_contact_force_from_the_same_state_agrees_with_c(
    jaco, mjx_step, c_step, history
):
    """Each engine takes one step from states in contact, of all three collisions.

    Within 1 % of the force or 0.2 N: a float32 penetration of 1 mm is exact to about
    1e-7 m, which the stiff contact turns into some 0.1 N.
    """
    model = jaco.scene.model
    states, torques, _ = history
    contacts = jax.vmap(jax.vmap(lambda s: read_contacts(model, s)))(states)
    busy = np.argwhere(np.asarray(contacts.touching.any(-1)))
    chosen = busy[np.linspace(0, len(busy) - 1, LANES).astype(int)]
    assert set(chosen[:, 1]) == {1, 2, 3}
    at, lane = chosen.T
    state = jax.tree.map(lambda x: x[at, lane], states)
    ours = read_all(model, mjx_step(state, torques[at, lane]))
    theirs = read_all(model, c_step(state, torques[at, lane]))
    np.testing.assert_array_equal(ours.touching, theirs.touching)
    np.testing.assert_allclose(ours.force, theirs.force, rtol=0.01, atol=0.2)
    assert np.max(theirs.force) > 100.0


def test_the_scripted_events_happen_at_the_same_step_and_as_hard(
    jaco, mjx_step, history
):
    """First contact at most one step apart, peak force on the first pair within 5 %."""
    model = jaco.scene.model
    mine, state = [], start(jaco, LANES)
    for torque in history[1][:100]:
        state = mjx_step(state, torque[np.arange(LANES) % 4])
        mine.append(read_all(model, jax.tree.map(lambda x: x[:4], state)))
    force = np.stack([c.force for c in mine])
    states = jax.tree.map(lambda x: x[1:101], history[0])
    true = jax.vmap(jax.vmap(lambda s: read_contacts(model, s)))(states)
    true_force = np.asarray(true.force)
    for lane in (1, 2):
        first = [np.argmax(f[:, lane].sum(-1) > 0) for f in (force, true_force)]
        assert abs(int(first[0]) - int(first[1])) <= 1
        pair = int(np.argmax(true_force[first[1], lane]))
        window = slice(0, first[1] + 8)
        peaks = [f[window, lane, pair].max() for f in (force, true_force)]
        assert peaks[0] == pytest.approx(peaks[1], rel=0.05)


def test_a_bad_lane_comes_back_as_nan_and_alone(jaco, mjx_step):
    state = start(jaco, LANES)
    torque = jnp.zeros((LANES, 7)).at[2, 0].set(jnp.nan)
    state = state.replace(qpos=state.qpos.at[1, 2].set(jnp.nan))
    after = mjx_step(state, torque)
    assert np.all(np.isnan(after.qvel[1])) and np.any(np.isnan(after.qvel[2]))
    assert np.all(np.isfinite(after.qpos[3:])) and np.all(np.isfinite(after.qpos[0]))


def test_the_state_keeps_its_types(jaco, mjx_step):
    state = start(jaco, LANES)
    after = mjx_step(state, jnp.zeros((LANES, 7)))
    assert jax.tree.map(jnp.shape, state) == jax.tree.map(jnp.shape, after)
    assert jax.tree.map(lambda x: x.dtype, state) == jax.tree.map(
        lambda x: x.dtype, after
    )


def read_all(model, state):
    return _read(model)(state)


@functools.cache
def _read(model):
    return jax.jit(jax.vmap(lambda s: read_contacts(model, s)))
