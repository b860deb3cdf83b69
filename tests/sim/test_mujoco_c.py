"""The C engine behind the callback against a plain loop of MuJoCo's own step."""

import copy
import threading

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rmp_mjx.sim import PhysicsError, load_physics, read_contacts

STEPS = 200  # 1 s of the arm: free motion and hard contact in four lanes


@pytest.fixture(scope="module")
def engine(jaco):
    return load_physics("mujoco", jaco.scene.model)


@pytest.fixture(scope="module")
def step(engine):
    return jax.jit(jax.vmap(engine.step))


def start(engine, jaco, dtype):
    q, mocap = jnp.asarray(jaco.q, dtype), jnp.asarray(jaco.mocap, dtype)
    return jax.vmap(engine.init)(q, jnp.zeros_like(q), mocap)


def largest_difference(engine, step, jaco, reference, dtype):
    """Over all lanes and steps: of q, qd and of the sensors, relative to 1."""
    state, worst = start(engine, jaco, dtype), 0.0
    loops = [
        reference(jaco.scene.model, q, mocap, dtype)
        for q, mocap in zip(jaco.q, jaco.mocap, strict=True)
    ]
    for k in range(STEPS):
        torque = jaco.torque(k).astype(dtype)
        state = step(state, jnp.asarray(torque))
        for lane, loop in enumerate(loops):
            loop.step(torque[lane])
            for mine, theirs in (
                (state.qpos, loop.data.qpos),
                (state.qvel, loop.data.qvel),
                (state.sensors, loop.data.sensordata.astype(dtype)),
            ):
                error = np.abs(np.asarray(mine[lane], float) - theirs)
                worst = max(worst, np.max(error / np.maximum(1.0, np.abs(theirs))))
    return worst


def test_in_double_precision_it_is_the_plain_loop_bit_for_bit(engine, jaco, reference):
    with jax.enable_x64(True):
        step = jax.jit(jax.vmap(engine.step))
        assert largest_difference(engine, step, jaco, reference, np.float64) == 0.0


def test_called_from_another_device_it_does_the_same(engine, step, jaco, monkeypatch):
    """No other device is here: its branch of the program runs on the CPU."""
    state, torque = start(engine, jaco, np.float32), jnp.asarray(jaco.torque(0))
    want = step(state, torque)
    monkeypatch.setattr(
        jax.lax, "platform_dependent", lambda *args, cpu, default: default(*args)
    )
    other = jax.jit(jax.vmap(lambda state, ctrl: engine.step(state, ctrl)))
    found = other(state, torque)
    jax.tree.map(np.testing.assert_array_equal, found, want)


def test_in_single_precision_it_is_the_loop_with_a_rounded_state_bit_for_bit(
    engine, step, jaco, reference
):
    assert largest_difference(engine, step, jaco, reference, np.float32) == 0.0


def test_each_simulation_has_its_own_values_of_the_model_bit_for_bit(
    engine, jaco, reference
):
    factor = np.array([0.5, 1.0, 1.5, 2.0])
    own = {
        name: factor.reshape(-1, *[1] * value.ndim) * value
        for name in ("body_mass", "dof_armature", "body_inertia", "pair_friction")
        for value in [getattr(jaco.scene.model, name)]
    }
    loops = []
    for lane, (q, mocap) in enumerate(zip(jaco.q, jaco.mocap, strict=True)):
        model = copy.copy(jaco.scene.model)
        for name, values in own.items():
            getattr(model, name)[:] = values[lane]
        loops.append(reference(model, q, mocap))
    with jax.enable_x64(True):
        step = jax.jit(jax.vmap(engine.step))
        state = start(engine, jaco, np.float64)
        state = state.replace(model={k: jnp.asarray(v) for k, v in own.items()})
        for k in range(50):
            state = step(state, jnp.asarray(jaco.torque(k)))
            for lane, loop in enumerate(loops):
                loop.step(jaco.torque(k)[lane])
        found = np.asarray(state.qpos)
    np.testing.assert_array_equal(found, [loop.data.qpos for loop in loops])
    assert np.ptp(found[:1] - jaco.q[0]) > 1e-3  # half the mass: the arm rises


def test_rounding_the_state_to_float32_hardly_moves_the_arm(
    engine, step, jaco, reference
):
    """Free motion over 1 s within 2e-5 rad: 200 roundings of 2e-7 rad, amplified."""
    state, loop = (
        start(engine, jaco, np.float32),
        reference(jaco.scene.model, jaco.q[0]),
    )
    for k in range(STEPS):
        state = step(state, jnp.asarray(jaco.torque(k), jnp.float32))
        loop.step(jaco.torque(k)[0])
    assert loop.data.ncon == 0
    np.testing.assert_allclose(state.qpos[0], loop.data.qpos, atol=2e-5)


def test_the_step_remembers_nothing(engine, step, jaco):
    torque = jnp.asarray(jaco.torque(3), jnp.float32)
    first = start(engine, jaco, np.float32)
    other = first.replace(qvel=first.qvel + 1.0, qpos=first.qpos.at[1].set(jnp.nan))
    once = step(first, torque)
    step(other, 2.0 * torque)
    again = step(first, torque)
    jax.tree.map(np.testing.assert_array_equal, once, again)


def test_nested_vmap_is_a_loop(engine, step, jaco):
    torque = jnp.asarray(jaco.torque(5), jnp.float32)
    state = start(engine, jaco, np.float32)
    flat = step(state, torque)
    fold = lambda x: x.reshape(2, 2, *x.shape[1:])  # noqa: E731
    nested = jax.jit(jax.vmap(jax.vmap(engine.step)))(
        jax.tree.map(fold, state), fold(torque)
    )
    jax.tree.map(np.testing.assert_array_equal, jax.tree.map(fold, flat), nested)
    one = jax.jit(engine.step)(jax.tree.map(lambda x: x[2], state), torque[2])
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[2], b), flat, one)


@pytest.mark.parametrize(
    ("field", "value"),
    [("qpos", np.nan), ("qvel", np.inf), ("qvel", 1e9), ("ctrl", np.nan)],
)
def test_a_bad_lane_comes_back_as_nan_and_alone(engine, step, jaco, field, value):
    """MuJoCo would reset the arm, or drop the torque, and it would look safe."""
    torque = jnp.asarray(jaco.torque(0), jnp.float32)
    state = start(engine, jaco, np.float32)
    good = step(state, torque)
    if field == "ctrl":
        bad = step(state, torque.at[1, 2].set(value))
    else:
        spoilt = getattr(state, field).at[1, 2].set(value)
        bad = step(state.replace(**{field: spoilt}), torque)
    for name in ("qpos", "qvel", "warmstart", "sensors"):
        assert np.all(np.isnan(getattr(bad, name)[1])), name
        rest, others = (
            np.delete(np.asarray(getattr(s, name)), 1, axis=0) for s in (good, bad)
        )
        np.testing.assert_array_equal(rest, others)


def test_an_obstacle_at_no_place_is_a_bad_lane(engine, step, jaco):
    state = start(engine, jaco, np.float32)
    state = state.replace(mocap_pos=state.mocap_pos.at[2].set(jnp.nan))
    after = step(state, jnp.asarray(jaco.torque(0), jnp.float32))
    assert np.all(np.isnan(after.qpos[2])) and np.all(np.isfinite(after.qpos[:2]))


def test_threads_do_not_disturb_each_other(engine, step, jaco):
    """Two programs may run at once: training and an evaluation, for instance."""
    torque = jnp.asarray(jaco.torque(0), jnp.float32)
    state = start(engine, jaco, np.float32)
    states = [state, state.replace(qvel=state.qvel + 0.5)]
    expected = [step(s, torque) for s in states]
    wrong = []

    def work(mine, right):
        for _ in range(300):
            if not np.array_equal(step(mine, torque).qpos, right.qpos):
                wrong.append(1)

    threads = [
        threading.Thread(target=work, args=pair)
        for pair in zip(states, expected, strict=True)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_contact_sensors_are_the_contact_forces_of_mujoco(
    engine, step, jaco, reference
):
    """Every watched pair at every step of every scripted collision, to 1e-6 N + 1e-6.

    The reference rounds its state as the engine does; what is left is the rounding
    of the forces themselves.
    """
    model = jaco.scene.model
    pairs = [
        [model.geom(model.sensor_objid[i]).name, model.geom(model.sensor_refid[i]).name]
        for i in range(model.nsensor)
    ]
    state = start(engine, jaco, np.float32)
    loops = [
        reference(model, q, mocap, np.float32)
        for q, mocap in zip(jaco.q, jaco.mocap, strict=True)
    ]
    read = jax.jit(jax.vmap(lambda s: read_contacts(model, s)))
    touched = set()
    for k in range(STEPS):
        state = step(state, jnp.asarray(jaco.torque(k), jnp.float32))
        contacts = read(state)
        for lane, loop in enumerate(loops):
            loop.step(jaco.torque(k)[lane])
            forces = [loop.force(*pair) for pair in pairs]
            np.testing.assert_allclose(
                contacts.force[lane], forces, rtol=1e-6, atol=1e-6
            )
            geoms = {
                frozenset(model.geom(g).name for g in c.geom)
                for c in loop.data.contact
                if c.dist < 0
            }
            flags = np.asarray(contacts.touching[lane])
            mine = {frozenset(p) for p, t in zip(pairs, flags, strict=True) if t}
            assert mine == geoms
            touched |= {(lane, *sorted(pair)) for pair in geoms}
    assert not [t for t in touched if t[0] == 0]  # the free motion touches nothing
    assert (1, "arm/fingers", "table") in touched
    assert (2, "arm/fingers", "sphere_0") in touched
    assert [t for t in touched if t[0] == 3 and "table" not in t]


def test_an_unknown_engine_is_refused_with_the_valid_names(weights):
    with pytest.raises(PhysicsError, match=r"'bullet'.*auto, mujoco, mjx"):
        load_physics("bullet", weights)


def test_mjx_names_what_it_cannot_simulate(weights):
    spec_model = mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")
    spec_model.opt.solver = mujoco.mjtSolver.mjSOL_PGS
    with pytest.raises(PhysicsError, match="PGS"):
        load_physics("mjx", spec_model)


def test_auto_is_the_c_engine_on_a_cpu(weights):
    kind = "MujocoPhysics" if jax.default_backend() == "cpu" else "MjxPhysics"
    assert type(load_physics("auto", weights)).__name__ == kind


def test_ten_solver_iterations_give_the_force_of_a_hundred(jaco, reference):
    """At every step of the scripted impacts (up to 1.2 kN), to 1e-6 of the force."""
    model = copy.copy(jaco.scene.model)
    assert model.opt.iterations == 10
    model.opt.iterations = model.opt.ls_iterations = 100
    greatest = 0.0
    for lane in (1, 2, 3):
        ours = reference(jaco.scene.model, jaco.q[lane], jaco.mocap[lane])
        exact = reference(model, jaco.q[lane], jaco.mocap[lane])
        for k in range(STEPS):
            for field in ("qpos", "qvel", "qacc_warmstart"):
                getattr(exact.data, field)[:] = getattr(ours.data, field)
            ours.step(jaco.torque(k)[lane])
            exact.step(jaco.torque(k)[lane])
            forces = [np.array(r.data.efc_force) for r in (ours, exact)]
            np.testing.assert_allclose(*forces, rtol=1e-6, atol=1e-6)
            greatest = max(greatest, np.max(forces[1], initial=0.0))
    assert greatest > 1000.0
