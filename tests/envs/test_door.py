"""The door task against its own words, in NumPy, and against MuJoCo C."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs.door import GOAL, HANDLE, VARIANTS
from envs.safety import SafetyRecord
from rmp_mjx.robot import Robot
from rmp_mjx.sim.base import pair_sensors
from tests.envs.arm_tasks import LANES, Torques

BARS = set(HANDLE)
HAND = {"arm/hand", "arm/fingers"}


@pytest.fixture(scope="module")
def env():
    """With a toy controller that holds the arm where it starts."""
    robot = Robot.load("jaco2")
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = envs.ENVS["door"].q_start
    mujoco.mj_forward(robot.mj_model, data)
    hold = Torques(np.asarray(data.qfrc_bias, np.float32))
    options = {"physics": "mujoco", "obstacles": 2, "layout": "close"}
    return envs.load("door", controller=hold, **options)


@pytest.fixture(scope="module")
def scene(env):
    """Model and data of the scene, for MuJoCo C."""
    return env.scene.model, mujoco.MjData(env.scene.model)


@pytest.fixture(scope="module")
def starts(env):
    return jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 500))


def opened(starts, angle, rate=0.0):
    """The first start of a batch with its door open."""
    data = jax.tree.map(lambda x: x[0], starts.data)
    return data.replace(qpos=data.qpos.at[7].set(angle), qvel=data.qvel.at[7].set(rate))


def score(env, data, site=None, held=0, **record):
    """Score of one policy step that led to `data`; the grip is in place."""
    site = env.site(data) if site is None else site
    record = {name: jnp.asarray(value) for name, value in record.items()}
    task = {"held": jnp.int32(held), "grip_force": jnp.zeros(())}
    return env.score(data, site, SafetyRecord.empty().replace(**record), task, 1)


@pytest.mark.parametrize(("angle", "rate"), [(0.0, 0.0), (0.4, 1.2), (1.3, -0.5)])
def test_the_tree_sees_the_panel_of_the_physics(env, scene, starts, angle, rate):
    """Place, size, turn and both velocities; float32 rounds to 1e-6."""
    model, d = scene
    data = opened(starts, angle, rate)
    d.qpos[:], d.qvel[:] = data.qpos, data.qvel
    mujoco.mj_kinematics(model, d)
    mujoco.mj_comPos(model, d)
    mujoco.mj_comVel(model, d)
    panel, velocity = model.geom("door/panel").id, np.zeros(6)
    mujoco.mj_objectVelocity(model, d, mujoco.mjtObj.mjOBJ_GEOM, panel, velocity, 0)
    lane = jax.tree.map(lambda x: x[0], starts.info["spheres"])
    seen = env.obstacles(data, lane).boxes
    expected = {
        "center": d.geom_xpos[panel],
        "rotation": d.geom_xmat[panel].reshape(3, 3),
        "half_size": model.geom_size[panel],
        "velocity": velocity[3:],
        "angular_velocity": velocity[:3],
    }
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(seen, name)[0], value, atol=1e-6)
    assert np.all(seen.active) and seen.radius[0] == 0.0
    handle = d.site_xpos[model.site("door/grasp").id]
    np.testing.assert_allclose(env.grasp_at(jnp.float32(angle)), handle, atol=1e-6)


def test_the_tree_keeps_the_links_but_not_the_hand_off_the_handle(env, scene, starts):
    """The box in the tree encloses the bars of the physics; 1e-6 m for float32."""
    model, d = scene
    data = opened(starts, 0.4)
    d.qpos[:], d.qvel[:] = data.qpos, data.qvel
    mujoco.mj_kinematics(model, d)
    lane = jax.tree.map(lambda x: x[0], starts.info["spheres"])
    seen = env.obstacles(data, lane).boxes
    assert seen.hand_may_touch.tolist() == [False, True]
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for name in HANDLE:
        bar = model.geom(name).id
        radius, half = model.geom_size[bar, :2]
        axis = d.geom_xmat[bar].reshape(3, 3)[:, 2]
        for end in (-half, half):
            tip = seen.rotation[1].T @ (d.geom_xpos[bar] + end * axis - seen.center[1])
            low, high = np.minimum(low, tip - radius), np.maximum(high, tip + radius)
    np.testing.assert_allclose(low, -seen.half_size[1], atol=1e-6)
    np.testing.assert_allclose(high, seen.half_size[1], atol=1e-6)


def test_the_door_opens_towards_the_arm(env):
    """The way of the grip, by plane trigonometry about the hinge at (.70, .20)."""
    t = np.linspace(0.0, GOAL, 5)
    x = 0.70 - 0.32 * np.sin(t) - 0.14 * np.cos(t)
    y = 0.20 - 0.32 * np.cos(t) + 0.14 * np.sin(t)
    way = jax.vmap(env.grasp_at)(jnp.asarray(t, jnp.float32))
    np.testing.assert_allclose(way, np.stack([x, y, 0 * t + 0.075], 1), atol=1e-6)


def test_the_finger_starts_in_the_handle_with_room_on_all_sides(env, scene):
    """It is to have 10 mm of play (8 mm allow for the start being rounded to 1 mrad),
    the grip is at its place, and the arm is well off the panel."""
    model, d = scene
    d.qpos[:], d.qvel[:] = 0.0, 0.0
    d.qpos[:7] = env.q_start
    mujoco.mj_kinematics(model, d)
    distance = lambda a, b: mujoco.mj_geomDistance(  # noqa: E731
        model, d, model.geom(a).id, model.geom(b).id, 1.0, None
    )
    assert min(distance("arm/fingers", bar) for bar in HANDLE) > 0.008
    assert min(distance("arm/hand", bar) for bar in HANDLE) > 0.008
    assert min(distance(part, "door/panel") for part in HAND) > 0.07
    sites = (model.site(name).id for name in ("arm/grip", "door/grasp"))
    np.testing.assert_allclose(*(d.site_xpos[s] for s in sites), atol=2e-3)


def test_starts_leave_the_finger_in_the_handle(env, scene, starts):
    """Not one of 500 presses a bar by more than a millimetre."""
    model, d = scene
    deepest = 1.0
    for q in np.asarray(starts.data.qpos):
        d.qpos[:] = q
        mujoco.mj_kinematics(model, d)
        for bar in HANDLE:
            ids = model.geom("arm/fingers").id, model.geom(bar).id
            deepest = min(deepest, mujoco.mj_geomDistance(model, d, *ids, 1.0, None))
    assert deepest > -1e-3


def test_the_hand_may_touch_the_handle_and_nothing_else(env):
    scene = env.scene
    name = lambda k: scene.model.geom(k).name  # noqa: E731
    ids = pair_sensors(scene.model)
    sides = (scene.model.sensor_objid[ids], scene.model.sensor_refid[ids])
    pairs = list(zip(*(map(name, side) for side in sides), strict=True))
    work = {pair for pair, on in zip(pairs, scene.work, strict=True) if on}
    assert work == {(hand, bar) for hand in HAND for bar in BARS}
    hand = {b for (a, b), on in zip(pairs, scene.hand, strict=True) if on and a in HAND}
    assert hand == {"table", "door/panel", "sphere_0", "sphere_1"}
    arm = {b for (_, b), on in zip(pairs, scene.arm, strict=True) if on}
    assert arm == hand | BARS
    rough = scene.model.pair_dim == 3
    assert np.sum(rough) == len(work)
    assert np.all(scene.model.pair_friction[rough, 0] == 0.5)
    assert np.all(scene.model.pair_dim[~rough] == 1)


def test_contacts_fit_the_documented_slots(env):
    """docs/tasks.md: without spheres 57 pairs; each can report two contacts, as many as
    a capsule can have on a box or a plane."""
    model = envs.load("door", controller=env.controller, physics="mujoco").scene.model
    assert model.npair == 57
    assert int(np.sum(model.pair_dim == 3)) == 8


def test_pulling_the_handle_is_work(env, starts):
    """Torques that pull the hand at about 12 N open the door, without a collision."""
    step = jax.jit(jax.vmap(env.step))
    state = jax.tree.map(lambda x: x[:LANES], starts)
    site = env.site(jax.tree.map(lambda x: x[0], state.data))
    pull = np.asarray(site.J_pos).T @ np.array([-12.0, 4.0, 0.0])
    action = jnp.zeros((LANES, 12)).at[:, :6].set(pull[:6])
    worked = []
    for _ in range(4):
        state = step(state, action)
        worked.append(state.metrics["work_force"])
        assert not np.any(state.metrics["collision"])
    assert np.all(np.max(worked, axis=0) > 2.0)
    assert np.all(state.metrics["door_angle"] > 0.02)
    assert not np.any(state.metrics["contact_overflow"])


@pytest.mark.parametrize("angle", [0.0, 0.6, 0.985, 0.995, 1.04, 1.085, 1.095, 1.4])
@pytest.mark.parametrize("rate", [0.0, -0.09, 0.11, -0.8])
def test_reward_of_the_hinge(env, starts, angle, rate):
    """The docstring's formula; the grip is far from the handle: 0.5 (1 - tanh 3 d)."""
    data = opened(starts, angle, rate)
    site = env.site(data)
    d = np.linalg.norm(np.asarray(env.grasp_at(jnp.float32(angle))) - site.p)
    on = d < 0.01
    miss = abs(GOAL - angle)
    expected = 30.0 * (GOAL - miss) - 10.0 * abs(rate)
    if miss < 0.05 and abs(rate) < 0.1:
        expected = 500.0
    expected += 1.0 if on else 0.5 * (1.0 - np.tanh(3.0 * d))
    assert float(score(env, data).reward) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("off", "on"),
    [
        ((0.0, 0.0, 0.0), True),
        ((0.009, 0.0, 0.019), True),
        ((0.008, 0.008, 0.0), False),
        ((0.0, 0.0, 0.021), False),
        ((0.011, 0.0, 0.0), False),
    ],
)
def test_reward_of_a_hand_on_the_handle(env, starts, off, on):
    data = opened(starts, 0.3)
    site = env.site(data).replace(p=env.grasp_at(jnp.float32(0.3)) + np.array(off))
    hinge = 30.0 * 0.3
    expected = 1.0 if on else 0.5 * (1.0 - np.tanh(3.0 * np.linalg.norm(off)))
    got = float(score(env, data, site).reward)
    assert got - hinge == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(
    ("force", "cost"), [((60.0, 30.0), 0.0), ((60.0, 50.0), 5.5), ((0.0, 200.0), 10.0)]
)
def test_forces_beyond_100_newton_cost(env, starts, force, cost):
    """Collisions and work count together."""
    data, (unwanted, work) = opened(starts, 0.3), force
    calm = score(env, data).reward
    hard = score(env, data, contact_force=unwanted, work_force=work).reward
    assert float(calm - hard) == pytest.approx(cost, abs=1e-4)


def test_a_door_held_for_half_a_second_is_open(env, starts):
    """Ten policy steps at rest near the goal, in a row."""
    there, away = opened(starts, 1.0), opened(starts, 0.98)
    task = score(env, there, held=8)
    assert not task.success and task.task["held"] == 9
    assert score(env, there, held=9).success
    assert not score(env, away, held=9).success
    assert score(env, away, held=9).task["held"] == 0
    assert score(env, opened(starts, 1.0, 0.2), held=9).task["held"] == 0


def test_the_observation_tells_hinge_handle_and_contact(env, starts):
    data = opened(starts, 0.5, -0.2)
    site = env.site(data)
    for force in (0.0, 3.0):
        task = {"held": jnp.int32(0), "grip_force": jnp.float32(force)}
        seen = env.observe(data, site, task)
        assert [seen["angle"], seen["rate"]] == pytest.approx([0.5, -0.2])
        place = env.grasp_at(jnp.float32(0.5))
        np.testing.assert_allclose(site.p + seen["handle"], place, atol=1e-6)
        assert seen["contact"] == (force > 0)


def test_spheres_never_block_the_door(env, scene, starts):
    """Panel and handle pass every sphere of 500 close layouts, to 0.06 rad beyond the
    goal; and all spheres found a place."""
    model, d = scene
    assert np.all(starts.info["spheres"].placed)
    centers = np.asarray(starts.data.mocap_pos).reshape(-1, 3)
    moving = [model.geom(name) for name in ("door/panel", *HANDLE)]
    gap = np.full(len(centers), np.inf)
    d.qpos[:7] = env.q_start
    for angle in np.linspace(0.0, GOAL + 0.06, 12):
        d.qpos[7] = angle
        mujoco.mj_kinematics(model, d)
        for geom in moving:
            local = (centers - d.geom_xpos[geom.id]) @ d.geom_xmat[geom.id].reshape(
                3, 3
            )
            if geom.type == mujoco.mjtGeom.mjGEOM_BOX:
                off = np.maximum(np.abs(local) - geom.size, 0.0)
                radius = 0.0
            else:
                reach = np.array([0.0, 0.0, geom.size[1]])
                off, radius = local - np.clip(local, -reach, reach), geom.size[0]
            gap = np.minimum(gap, np.linalg.norm(off, axis=1) - radius)
    assert np.min(gap) - env.options.sphere_radius > 0.0


@pytest.mark.parametrize("name", VARIANTS)
def test_variants_differ_in_mass_damping_and_friction(env, name):
    loaded = envs.load(
        "door", controller=env.controller, physics="mujoco", variant=name
    )
    model, variant = loaded.scene.model, VARIANTS[name]
    assert model.body("door/door").mass == pytest.approx(variant.mass)
    assert model.dof_damping[7] == variant.damping
    assert model.dof_frictionloss[7] == variant.friction


def test_an_unknown_variant_is_refused():
    with pytest.raises(ValueError, match=r"'haevy'.*light, heavy, vices.*'heavy'"):
        envs.load("door", variant="haevy")
