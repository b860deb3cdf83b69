"""The push task against its own words, in NumPy, and against MuJoCo C."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs.push import FARTHEST_GOAL, GOAL_HIGH, GOAL_LOW, NEAREST_GOAL, PushOptions
from envs.safety import SafetyRecord
from envs.scene import TABLE_HEIGHT
from rmp_mjx.robot import Robot
from rmp_mjx.sim.base import pair_sensors
from tests.envs.arm_tasks import Torques

HAND = {"arm/hand", "arm/fingers"}
CORNERS = 0.03 * np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3)
GRAVITY = 9.81


def load(**options):
    """The task with a toy controller that holds the arm where it starts."""
    robot = Robot.load("jaco2")
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = envs.ENVS["push"].q_start
    mujoco.mj_forward(robot.mj_model, data)
    hold = Torques(np.asarray(data.qfrc_bias, np.float32))
    return envs.load("push", controller=hold, physics="mujoco", **options)


@pytest.fixture(scope="module")
def env():
    return load(obstacles=2, layout="close")


@pytest.fixture(scope="module")
def plain():
    """With the paper's reward and observation."""
    return load(guided=False)


@pytest.fixture(scope="module")
def starts(env):
    return jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 1000))


@pytest.fixture
def lane(starts):
    return jax.tree.map(lambda x: x[0], starts)


def score(env, lane, grip, block, goal):
    """Score with grip, block and goal where they are said to be."""
    n = env.robot.n
    data = lane.data.replace(qpos=lane.data.qpos.at[n : n + 3].set(jnp.array(block)))
    site = env.site(data).replace(p=jnp.array(grip))
    task = {"start": lane.task["start"], "goal": jnp.array(goal)}
    return env.score(data, site, SafetyRecord.empty(), task, 1)


def test_block_and_goal_start_in_their_areas_ten_to_25_centimetres_apart(starts):
    block = np.asarray(starts.data.qpos[:, 7:10])
    goal = np.asarray(starts.task["goal"])
    assert np.all((block[:, 0] > 0.42) & (block[:, 0] < 0.52))
    assert np.all(np.abs(block[:, 1]) < 0.10)
    assert np.all((goal[:, :2] >= GOAL_LOW) & (goal[:, :2] <= GOAL_HIGH))
    distance = np.linalg.norm(goal - block, axis=1)
    assert distance.min() >= NEAREST_GOAL and distance.max() <= FARTHEST_GOAL
    assert distance.min() < 0.11 and distance.max() > 0.24
    np.testing.assert_allclose(block[:, 2], TABLE_HEIGHT + 0.03, atol=1e-6)
    np.testing.assert_allclose(goal[:, 2], TABLE_HEIGHT + 0.03, atol=1e-6)
    turn = 2 * np.arctan2(starts.data.qpos[:, 13], starts.data.qpos[:, 10])
    assert turn.min() == pytest.approx(-np.pi / 4, abs=0.01)
    assert turn.max() == pytest.approx(np.pi / 4, abs=0.01)


def test_the_tree_keeps_the_links_but_not_the_hand_off_the_block(env, lane):
    """Place, turn, size and velocities as in MuJoCo C; 1e-6 for float32."""
    model = env.scene.model
    d = mujoco.MjData(model)
    motion = jnp.array([0.1, -0.2, 0.0, 0.3, 0.2, -0.5])
    data = lane.data.replace(qvel=lane.data.qvel.at[-6:].set(motion))
    d.qpos[:], d.qvel[:] = data.qpos, data.qvel
    mujoco.mj_forward(model, d)
    block, velocity = model.geom("push/block").id, np.zeros(6)
    mujoco.mj_objectVelocity(model, d, mujoco.mjtObj.mjOBJ_GEOM, block, velocity, 0)
    seen = env.obstacles(data, lane.info["spheres"]).boxes
    expected = {
        "center": d.geom_xpos[block],
        "rotation": d.geom_xmat[block].reshape(3, 3),
        "half_size": model.geom_size[block],
        "velocity": velocity[3:],
        "angular_velocity": velocity[:3],
    }
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(seen, name)[0], value, atol=1e-6)
    assert seen.hand_may_touch.tolist() == [True]


def test_a_block_that_is_not_touched_rests(env, lane):
    """It sinks into the soft contact by less than 0.5 mm, in 1 s of MuJoCo C."""
    _, d = settled(env, lane)
    start = np.asarray(lane.task["start"])
    np.testing.assert_allclose(d.qpos[7:10], start, atol=5e-4)
    assert np.abs(d.qvel[7:]).max() < 1e-3


def settled(env, lane, seconds=1.0):
    model = env.scene.model
    d = mujoco.MjData(model)
    d.qpos[:] = lane.data.qpos
    d.ctrl[:] = env.controller.hold
    d.mocap_pos[:] = [0.0, 0.0, -5.0]
    for _ in range(round(seconds / model.opt.timestep)):
        d.qpos[:7], d.qvel[:7] = env.q_start, 0.0  # the arm out of the way
        mujoco.mj_step(model, d)
    return model, d


@pytest.mark.parametrize("friction", [0.3, 0.5])
def test_a_sliding_block_stops_where_coulomb_says(friction):
    """v^2 / (2 mu g), less v dt / 2 as the timestep makes it, along an axis of the
    friction pyramid; within 3 %: soft contact lets the block creep."""
    env = load(block_friction=friction)
    state = env.reset(jax.random.key(0))
    state = state.replace(
        data=state.data.replace(
            qpos=state.data.qpos.at[10:14].set(jnp.array([1.0, 0.0, 0.0, 0.0]))
        )
    )
    model, d = settled(env, state, 0.2)
    x = d.qpos[7]
    d.qvel[7] = 0.4
    for _ in range(200):
        d.qpos[:7], d.qvel[:7] = env.q_start, 0.0
        mujoco.mj_step(model, d)
    v, dt = 0.4, model.opt.timestep
    distance = v**2 / (2 * friction * GRAVITY) - 0.5 * v * dt
    assert d.qpos[7] - x == pytest.approx(distance, rel=0.03)


def test_the_hand_may_touch_the_block_and_nothing_else(env):
    scene = env.scene
    name = lambda k: scene.model.geom(k).name  # noqa: E731
    ids = pair_sensors(scene.model)
    sides = (scene.model.sensor_objid[ids], scene.model.sensor_refid[ids])
    pairs = list(zip(*(map(name, side) for side in sides), strict=True))
    work = {pair for pair, on in zip(pairs, scene.work, strict=True) if on}
    assert work == {(hand, "push/block") for hand in HAND}
    hand = {b for (a, b), on in zip(pairs, scene.hand, strict=True) if on and a in HAND}
    assert hand == {"table", "sphere_0", "sphere_1"}
    arm = {b for (_, b), on in zip(pairs, scene.arm, strict=True) if on}
    assert arm == hand | {"push/block"}


def test_contacts_fit_the_documented_slots():
    """docs/tasks.md: without spheres 26 pairs, three of them with friction."""
    model = load().scene.model
    assert model.npair == 26
    assert int(np.sum(model.pair_dim == 3)) == 3


GOAL = np.array([0.45, 0.10, -0.082])


@pytest.mark.parametrize("block", [(0.50, -0.05, -0.082), (0.44, 0.07, -0.082)])
@pytest.mark.parametrize("grip", [(0.40, 0.0, 0.04), (0.51, -0.09, -0.08)])
@pytest.mark.parametrize("guided", [True, False])
def test_reward_of_hand_and_block(env, plain, lane, grip, block, guided):
    """5 (1 - tanh 20 h) + 50 (1 - tanh 20 g); h to the hand's place 4.5 cm behind the
    block, or to the block itself."""
    grip, block = np.array(grip), np.array(block)
    g = np.linalg.norm(GOAL - block)
    behind = 0.045 * (GOAL - block) / g if guided else 0.0
    h = np.linalg.norm(block - behind - grip)
    expected = 5 * (1 - np.tanh(20 * h)) + 50 * (1 - np.tanh(20 * g))
    after = score(env if guided else plain, lane, grip, block, GOAL)
    assert float(after.reward) == pytest.approx(expected, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("guided", [True, False])
def test_the_observation_leads_from_hand_to_block_to_goal(env, plain, lane, guided):
    """And, guided, to where the hand belongs: behind the block, seen from the goal."""
    env = env if guided else plain
    task = {name: lane.task[name] for name in ("start", "goal")}
    site = env.site(lane.data)
    seen = env.observe(lane.data, site, task)
    block = site.p + seen["hand_to_block"]
    np.testing.assert_allclose(block, lane.data.qpos[7:10], atol=1e-6)
    goal = block + seen["block_to_goal"]
    np.testing.assert_allclose(goal, lane.task["goal"], atol=1e-6)
    names = [entry.name for entry in env.task_entries]
    assert names == ["hand_to_block", "block_to_goal", "hand_to_place"][: 2 + guided]
    place = site.p + seen["hand_to_place"] - block
    ahead = (goal - block) / np.linalg.norm(goal - block)
    np.testing.assert_allclose(place, -0.045 * ahead, atol=1e-6)


def test_a_block_at_its_goal_has_a_finite_reward(env, lane):
    after = score(env, lane, GOAL, GOAL, GOAL)
    assert float(after.reward) == pytest.approx(55.0, abs=1e-3)


def test_a_block_within_five_centimetres_is_home(env, lane):
    for distance, home in ((0.049, True), (0.051, False)):
        block = GOAL - np.array([0.0, distance, 0.0])
        after = score(env, lane, [0.3, 0.0, 0.2], block, GOAL)
        assert bool(after.success) == home
        assert float(after.metrics["goal_distance"]) == pytest.approx(distance)


def test_spheres_leave_block_and_goal_free(env, starts):
    """The block touches none of the spheres of 1,000 close layouts, at its start as it
    is turned, at the goal however it is turned; nearly all spheres find a place."""
    qpos, placed = (
        np.asarray(x) for x in (starts.data.qpos, starts.info["spheres"].placed)
    )
    assert np.mean(placed) > 0.99
    gap = np.inf
    for i in range(2):
        center = np.asarray(starts.data.mocap_pos[:, i])
        w, z = qpos[:, 10], qpos[:, 13]
        c, s = w * w - z * z, 2 * w * z
        x, y, up = (center - qpos[:, 7:10]).T
        local = np.stack([c * x + s * y, c * y - s * x, up], axis=1)
        over = np.linalg.norm(np.maximum(np.abs(local) - 0.03, 0.0), axis=1)
        away = center - np.asarray(starts.task["goal"])
        radial = np.maximum(np.hypot(*away[:, :2].T) - np.sqrt(2) * 0.03, 0.0)
        goal = np.hypot(radial, np.maximum(np.abs(away[:, 2]) - 0.03, 0.0))
        gap = min(gap, over[placed[:, i]].min(), goal[placed[:, i]].min())
    assert gap > env.options.sphere_radius


def test_a_block_without_mass_or_friction_is_refused():
    with pytest.raises(ValueError, match="block_mass must be positive, got 0"):
        PushOptions(block_mass=0.0)
    with pytest.raises(ValueError, match="block_friction must be positive, got 0"):
        PushOptions(block_friction=0.0)
