"""What an episode draws anew, and who learns of it."""

import json

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs.randomisation import RANGES, Motors, Randomisation, draw_model, draw_motors
from envs.scene import ARM

ALL = {
    "link_mass": (0.5, 2.0),
    "rotor_inertia": (0.5, 2.0),
    "joint_damping": (0.1, 1.0),
    "torque_constant": (0.9, 1.1),
    "control_delay": (0.005, 0.015),
    "object_mass": (0.5, 2.0),
    "object_friction": (0.5, 1.5),
    "object_damping": (0.5, 3.0),
}


@pytest.fixture(scope="module")
def push(make):
    """Block pushing with everything drawn, and 200 starts of it."""
    task = make("vices", "push", obstacles=0, **ALL, velocity_noise=0.01)
    task.starts = task.reset(jax.random.split(jax.random.key(0), 200))
    return task


def test_every_range_is_tested():
    assert set(ALL) == set(RANGES)


def test_by_default_nothing_is_drawn(far):
    assert far.starts.data.model == {}
    assert far.starts.info["control"].motors is None
    assert far.env.noise(jax.random.key(0)) is None


def test_the_drawn_fields_lie_in_their_ranges_and_fill_them(push):
    model, drawn = push.env.scene.model, push.starts.data.model
    arm = np.array([model.body(i).name.startswith(ARM) for i in range(model.nbody)])
    block = model.body("push/block").id
    of_arm = arm[model.dof_bodyid]
    rough = model.pair_dim > 1
    heavy = arm & (model.body_mass > 0)
    mass = drawn["body_mass"] / np.where(model.body_mass > 0, model.body_mass, 1.0)
    for name, found in {
        "link_mass": mass[:, heavy],
        "object_mass": mass[:, block],
        "rotor_inertia": drawn["dof_armature"][:, of_arm] / model.dof_armature[of_arm],
        "joint_damping": drawn["dof_damping"][:, of_arm] - model.dof_damping[of_arm],
        "object_friction": drawn["pair_friction"][:, rough, 0]
        / model.pair_friction[rough, 0],
    }.items():
        low, high = ALL[name]
        # Float32 rounds; 200 uniform draws miss an end's fifth once in 10^19.
        assert np.all(found >= low - 1e-5) and np.all(found <= high + 1e-5), name
        assert np.min(found) < low + 0.2 * (high - low), name
        assert np.max(found) > high - 0.2 * (high - low), name


def test_mass_and_inertia_of_a_body_are_scaled_alike(push):
    model, drawn = push.env.scene.model, push.starts.data.model
    some = model.body_mass > 0
    scale = drawn["body_mass"][:, some] / model.body_mass[some]
    inertia = scale[..., None] * model.body_inertia[some]
    # Two roundings of float32.
    np.testing.assert_allclose(drawn["body_inertia"][:, some], inertia, rtol=1e-6)


def test_contacts_without_friction_stay_so(push):
    model, drawn = push.env.scene.model, push.starts.data.model
    smooth = model.pair_dim == 1
    found = drawn["pair_friction"][:, smooth]
    given = np.broadcast_to(model.pair_friction[smooth], found.shape)
    np.testing.assert_array_equal(found, given.astype(np.float32))


def test_the_hinge_of_a_door_is_drawn_with_its_mass():
    env = envs.load("door", controller="vices")
    ranges = Randomisation(object_mass=(2.0, 2.0), object_damping=(3.0, 3.0))
    model, panel = env.scene.model, env.scene.model.body("door/door").id
    drawn = draw_model(jax.random.key(0), ranges, model)
    assert drawn["body_mass"][panel] == pytest.approx(2.0 * model.body_mass[panel])
    assert drawn["dof_damping"][-1] == pytest.approx(3.0 * model.dof_damping[-1])
    np.testing.assert_allclose(drawn["dof_damping"][:-1], model.dof_damping[:-1])


def test_a_delayed_motor_repeats_its_commands_late_and_scaled():
    motors = Motors(
        constant=jnp.array([1.0, 2.0]),
        delay=jnp.array(2),
        commands=jnp.zeros((4, 2)),
    )
    given = np.arange(1.0, 13.0).reshape(6, 2)
    found = []
    for tau in given:
        motors = motors.then(jnp.asarray(tau))
        found.append(motors.torque)
    late = np.concatenate([np.zeros((2, 2)), given[:-2]])
    np.testing.assert_array_equal(found, late * [1.0, 2.0])


def test_motors_hold_the_arm_until_the_first_command_arrives():
    hold = jnp.array([1.0, -2.0, 3.0])
    motors = draw_motors(
        jax.random.key(0), Randomisation(control_delay=(0.01, 0.01)), hold, 0.005
    )
    assert motors is not None
    for k in range(3):
        motors = motors.then(jnp.full(3, 9.0))
        np.testing.assert_array_equal(motors.torque, hold if k < 2 else 9.0)


def test_the_physics_of_a_step_are_those_of_the_drawn_model(push):
    """MuJoCo with the drawn fields; no command under way has reached the arm yet."""
    steps = 3  # the least delay of any episode holds the arm for one step
    start = jax.tree.map(lambda x: x[:8], push.starts)
    after = push.step(start, jnp.zeros((8, push.env.action_size)))
    lane = int(np.argmax(start.info["control"].motors.delay))
    assert start.info["control"].motors.delay[lane] == steps
    model = push.env.scene.model.__copy__()
    for name, value in start.data.model.items():
        getattr(model, name)[:] = value[lane]
    data = mujoco.MjData(model)
    data.qpos[:] = start.data.qpos[lane]
    motors = start.info["control"].motors
    data.ctrl[:] = motors.constant[lane] * motors.commands[lane, 0]
    for _ in range(steps):
        mujoco.mj_step(model, data)
    one = push.env.physics.step
    state = jax.tree.map(lambda x: x[lane], start.data)
    for _ in range(steps):
        state = one(state, jnp.asarray(data.ctrl, jnp.float32))
    # Three roundings of a state near 4 rad to float32.
    np.testing.assert_allclose(state.qpos, data.qpos, atol=1e-6)
    assert np.all(np.isfinite(after.obs))


def test_noise_reaches_controller_and_observer_alike(make, push):
    env, key = push.env, jax.random.key(3)
    noise = env.noise(key)
    assert np.std(noise.velocity) == pytest.approx(0.01, rel=0.4)  # 70 draws
    assert not np.any(noise.position) and not np.any(noise.observer)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"link_mass": (2.0, 1.0)}, "link_mass must be two numbers of at least 0"),
        ({"joint_damping": (-1.0, 1.0)}, "joint_damping must be two numbers"),
        ({"torque_constant": (0.0, 1.0)}, "torque_constant is a factor"),
        ({"control_delay": (0.0, 0.01, 0.02)}, "control_delay must be two numbers"),
        ({"position_noise": -1.0}, "position_noise must be at least 0"),
        ({"object_mass": (1.0, float("inf"))}, "object_mass must be finite"),
    ],
)
def test_a_range_that_is_none_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        envs.make_options("push", **wrong)


def test_ranges_survive_a_record_in_json():
    options = envs.make_options("push", **ALL)
    record = json.loads(json.dumps(vars(options)))
    assert envs.make_options("push", **record) == options
