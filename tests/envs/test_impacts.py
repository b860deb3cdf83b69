"""Speed, fault and energy of a collision, against MuJoCo's geometry and dynamics."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs.impacts import Moment, measure
from rmp_mjx.robot import Robot
from rmp_mjx.sim.base import pair_sensors
from tests.envs.arm_tasks import LANES, Torques

REST = jnp.zeros((LANES, 12))


def expected(model, data, pair, velocity):
    """Own speed, closing speed and energy of a pair, by MuJoCo; None if it is deep.

    The velocity of a mocap body is given: MuJoCo holds it to be at rest.
    """
    sensor = pair_sensors(model)[pair]
    arm, other = model.sensor_objid[sensor], model.sensor_refid[sensor]
    ends = np.zeros(6)
    distance = mujoco.mj_geomDistance(model, data, arm, other, 5.0, ends)
    if abs(distance) < 1e-3 or distance < -0.02:
        return None
    normal = (
        np.sign(distance) * (ends[3:] - ends[:3]) / np.linalg.norm(ends[3:] - ends[:3])
    )
    row = {}
    for geom, at in ((arm, ends[:3]), (other, ends[3:])):
        jac = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jac, None, at, model.geom_bodyid[geom])
        row[geom] = normal @ jac
    own = row[arm] @ data.qvel
    moving = row[other] @ data.qvel
    mocap = model.body_mocapid[model.geom_bodyid[other]]
    moving += normal @ velocity[mocap] if mocap >= 0 else 0.0
    Mq = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, Mq)
    mass = 1.0 / (row[arm][:7] @ np.linalg.solve(Mq[:7, :7], row[arm][:7]))
    energy = 0.5 * mass * own**2 if own > 1e-9 else 0.0  # else the mass may be infinite
    return own, own - moving, energy


@pytest.mark.parametrize("task", ["door", "push"])
def test_every_pair_is_measured_as_mujoco_does(task):
    """Random states of arm, object and spheres, whether they touch or not.

    Within 1e-3 of a speed of 1 m/s, 2e-3 of an energy: float32 kinematics, and a normal
    between points that are 1 mm apart at least.
    """
    env = envs.load(task, controller=Torques(np.zeros(7)), obstacles=2)
    model, scene = env.scene.model, env.scene
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    run = jax.jit(lambda moments: measure(scene, env.robot, moments))
    pairs, seen = len(scene.other), set()
    for trial in range(120):
        data.qpos[:7] = env.robot.q_home + rng.normal(0.0, 0.6, 7)
        data.qpos[7:] = model.qpos0[7:] + rng.normal(0.0, 0.3, model.nq - 7)
        data.qvel[:] = rng.normal(0.0, 1.0, model.nv)
        data.mocap_pos[:] = rng.uniform(-0.5, 0.5, (2, 3))
        if task == "push":
            data.qpos[10:14] /= np.linalg.norm(data.qpos[10:14])
        mujoco.mj_forward(model, data)
        velocity, pair = rng.normal(0.0, 0.5, (2, 3)), trial % pairs
        wanted = expected(model, data, pair, velocity)
        if wanted is None:
            continue
        begun = np.zeros((1, pairs), bool)
        begun[0, pair] = True
        arrays = data.qpos, data.qvel, data.mocap_pos, velocity
        qpos, qvel, centers, moves = (jnp.asarray(x, jnp.float32)[None] for x in arrays)
        found = run(Moment(qpos, qvel, centers, moves, jnp.asarray(begun)))
        own, closing, energy = wanted
        assert float(found.own) == pytest.approx(max(own, 0.0), abs=1e-3)
        assert float(found.closing) == pytest.approx(max(closing, 0.0), abs=1e-3)
        assert float(found.energy) == pytest.approx(energy, rel=5e-3, abs=2e-3)
        assert bool(found.at_fault) == (found.own > 0.01)
        if own > 0.0:
            seen.add(int(model.geom_type[scene.other[pair]]))
    kinds = mujoco.mjtGeom
    wanted = {kinds.mjGEOM_PLANE, kinds.mjGEOM_SPHERE, kinds.mjGEOM_BOX}
    assert {int(kind) for kind in wanted} <= seen
    assert (int(kinds.mjGEOM_CAPSULE) in seen) == (task == "door")


def test_of_several_collisions_the_fastest_counts(make):
    env = make("torques").env
    pairs = len(env.scene.other)
    rng = np.random.default_rng(1)
    qpos = jnp.asarray(env.robot.q_home + rng.normal(0, 0.1, (5, 7)), jnp.float32)
    qvel = jnp.asarray(rng.normal(0, 1, (5, 7)), jnp.float32)
    centers, velocity = jnp.full((5, 2, 3), 0.4), jnp.zeros((5, 2, 3))
    one = jax.jit(lambda begun: measure(
        env.scene, env.robot, Moment(qpos, qvel, centers, velocity, begun)
    ))  # fmt: skip
    some = [(0, 1), (2, 9), (4, 20)]
    alone = [one(jnp.zeros((5, pairs), bool).at[at].set(True)) for at in some]
    begun = jnp.zeros((5, pairs), bool)
    for at in some:
        begun = begun.at[at].set(True)
    both = one(begun)
    best = max(alone, key=lambda impact: float(impact.own))
    assert float(best.own) > 0.0
    assert float(both.own) == pytest.approx(float(best.own))
    assert float(both.energy) == pytest.approx(float(best.energy))
    none = one(jnp.zeros((5, pairs), bool))
    assert (float(none.own), float(none.closing), float(none.energy)) == (0, 0, 0)


def test_a_collision_is_the_arms_fault_if_it_moves_and_is_measured_once(make, quiet):
    """Lane 0 falls onto the table, a sphere runs into lane 1, one starts in lane 2."""
    task = make("torques", obstacle_speed=0.4, terminate_on_event=False)
    env = task.env
    model, data = env.scene.model, mujoco.MjData(env.scene.model)
    data.qpos[:7] = env.robot.q_home
    mujoco.mj_kinematics(model, data)
    elbow = data.geom("arm/link_5").xpos
    state = jax.tree.map(
        lambda x: x[:LANES], task.reset(jax.random.split(jax.random.key(0), LANES))
    )
    mocap = np.array(quiet.data.mocap_pos)
    mocap[1, 0] = elbow + np.array([0.0, 0.0, 0.041 + 0.05 + 0.005])
    mocap[2, 0] = elbow + np.array([0.0, 0.0, 0.041 + 0.05 - 0.003])
    velocity = np.zeros((LANES, 2, 3))
    velocity[1, 0, 2] = -0.4
    spheres = state.info["spheres"].replace(velocity=jnp.asarray(velocity))
    state = state.replace(
        data=quiet.data.replace(mocap_pos=jnp.asarray(mocap)),
        info=state.info | {"spheres": spheres},
    )
    action = REST.at[0, 1].set(25.0)
    rows = []
    for _ in range(10):
        state = task.step(state, action)
        rows.append({k: np.asarray(v) for k, v in state.metrics.items()})
    of = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    assert of["at_fault"][:, 0].sum() >= 1 and of["contact_speed"][:, 0].max() > 0.1
    assert of["contact_energy"][:, 0].max() > 0.01
    first = int(np.argmax(of["collision"][:, 1] > 0))
    assert of["collision"][first, 1] == 1 and of["at_fault"][first, 1] == 0
    assert of["closing_speed"][first, 1] == pytest.approx(0.4, abs=0.02)
    assert of["contact_speed"][first, 1] < 0.01
    assert of["collision"][0, 2] == 1 and of["at_fault"][0, 2] == 0
    resting = of["contact_speed"][:, 3:], of["closing_speed"][:, 3:]
    assert not np.any(resting)


def test_joint_speeds_and_torque_rates_beyond_the_robots_are_counted_and_end_nothing():
    robot = Robot.load("jaco2")
    robot = robot.replace(
        qd_max=np.full(7, 0.5, np.float32), tau_rate_max=np.full(7, 400.0, np.float32)
    )
    env = envs.load("trajectory", robot=robot, controller=Torques(np.zeros(7)))
    step = jax.jit(env.step)
    state = jax.jit(env.reset)(jax.random.key(0))
    seen = []
    for _ in range(3):
        state = step(state, jnp.zeros(12))  # it falls
        seen.append({k: float(v) for k, v in state.metrics.items()})
    assert seen[0]["torque_rate"] == 1.0  # from holding its weight to nothing, at once
    assert [row["torque_rate"] for row in seen[1:]] == [0.0, 0.0]
    assert seen[0]["joint_speed"] < 0.5 or seen[0]["joint_velocity"] == 1.0
    fast = [row["joint_speed"] > 0.5 for row in seen]
    assert any(fast)
    # Counted once, when it begins.
    assert [row["joint_velocity"] for row in seen] == [
        float(now and not any(fast[:k])) for k, now in enumerate(fast)
    ]
    ended = seen[-1]["collision"] or seen[-1]["joint_limit"]
    assert state.done == 0.0 or ended
