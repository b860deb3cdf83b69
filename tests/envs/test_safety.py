"""The safety record against MuJoCo C's own contacts, and what an event costs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.safety import Motion, Torques
from tests.envs.arm_tasks import LANES

DOWN, SPHERE, SIDE, LIMIT, TURN = 0, 1, 2, 3, 4  # lanes; the others rest
REST = jnp.zeros((LANES, 12))


@pytest.fixture(scope="module")
def scripted(quiet, arm):
    """One lane falls onto the table, one onto a sphere, one starts in a sphere that
    touches the forearm, one near a joint limit, one near two turns of a free joint."""
    robot_q = np.array(quiet.data.qpos)
    mocap = np.array(quiet.data.mocap_pos)
    grip = arm.site(robot_q[0])[0]
    mocap[SPHERE, 1] = grip - np.array([0.0, 0.0, 0.06])
    elbow = arm.data.geom("arm/link_5").xpos
    mocap[SIDE, 0] = elbow + np.array([0.0, 0.0, 0.041 + 0.05 - 0.003])
    robot_q[LIMIT, 5] = 5.14872 - 0.099
    robot_q[TURN, 0] = 2 * np.pi - 0.09
    data = quiet.data.replace(qpos=jnp.asarray(robot_q), mocap_pos=jnp.asarray(mocap))
    action = REST.at[DOWN, 1].set(25.0).at[SPHERE, 1].set(25.0)
    return quiet.replace(data=data), action


def roll_both(task, arm, state, action, steps):
    """Policy steps of the task beside those of MuJoCo C, for every lane."""
    tau = np.asarray(task.env.controller.hold) + np.concatenate(
        [np.asarray(action[:, :6]), np.zeros((LANES, 1))], axis=1
    )
    for _ in range(steps):
        rows = []
        for lane in range(LANES):
            data = {
                name: np.asarray(getattr(state.data, name)[lane])
                for name in ("qpos", "qvel", "warmstart", "mocap_pos")
            }
            rows.append(arm.roll(Fields(data), tau[lane], task.env.n_substeps))
        state = task.step(state, action)
        yield state, rows


class Fields:
    def __init__(self, values):
        self.__dict__.update(values)


def test_record_is_what_mujoco_reports_lane_by_lane(close, arm, scripted):
    """Forces within 2 % or 0.5 N: the task rounds its state to float32 ten times a
    policy step, and a stiff impact amplifies that. Events are equal: they count when
    they begin."""
    seen, before = set(), {}
    for after, rows in roll_both(close, arm, *scripted, steps=10):
        for lane, steps in enumerate(rows):
            pairs = {p for _, force in steps for p in force}
            own = {p for p in pairs if all(n.startswith("arm/") for n in p)}
            world = pairs - own
            hand = {"arm/hand", "arm/fingers"}
            flags = (
                ("collision", bool(world)),
                ("arm_collision", any(not (p & hand) for p in world)),
                ("self_collision", bool(own)),
            )
            for name, expected in flags:
                begun = expected and not before.get((name, lane), False)
                assert bool(after.metrics[name][lane]) == begun, (name, lane)
                before[name, lane] = expected
            mean = np.mean([sum(force.values()) for _, force in steps])
            peak = max((f for _, force in steps for f in force.values()), default=0.0)
            for name, expected in (
                ("contact_force", mean),
                ("contact_force_peak", peak),
                ("contact_impulse", mean * 0.05),
            ):
                assert after.metrics[name][lane] == pytest.approx(
                    expected, rel=0.02, abs=0.5
                )
            seen |= {(lane, *sorted(p)) for p in pairs}
    assert (DOWN, "arm/fingers", "table") in seen
    assert (SPHERE, "arm/fingers", "sphere_1") in seen
    assert (SIDE, "arm/link_5", "sphere_0") in seen
    assert {lane for lane, *_ in seen} == {DOWN, SPHERE, SIDE}


def test_joint_limit_events_begin_a_tenth_of_a_radian_from_the_limit(far, scripted):
    after = far.step(scripted[0], REST)
    np.testing.assert_array_equal(after.metrics["joint_limit"], np.eye(LANES)[LIMIT])
    np.testing.assert_array_equal(after.metrics["turn_limit"], np.eye(LANES)[TURN])


def test_an_event_costs_its_penalty_and_ends_the_episode(far, quiet, scripted):
    clean, after = far.step(quiet, REST), far.step(scripted[0], REST)
    assert after.done[LIMIT] == 1 and after.done[SIDE] == 1
    assert after.reward[SIDE] == pytest.approx(float(clean.reward[SIDE]) - 50, abs=1.0)
    assert after.done[TURN] == 0  # counted, not punished: the joint turns for ever
    resting = np.arange(LANES) > TURN
    assert not np.any(np.asarray(after.done)[resting])
    np.testing.assert_array_equal(after.reward[resting], clean.reward[resting])


def test_penalty_and_termination_can_be_switched(far, close, scripted):
    hard, soft = far.step(scripted[0], REST), close.step(scripted[0], REST)
    event = hard.done == 1
    assert np.sum(event) == 2 and not np.any(soft.done)
    np.testing.assert_allclose(
        soft.reward - hard.reward, np.where(event, 50.0 - 7.0, 0.0), atol=1e-3
    )


def test_a_sphere_that_found_no_place_is_counted(far, quiet):
    placed = jnp.ones((LANES, 2), bool).at[1, 0].set(False).at[2].set(False)
    missing = jnp.sum(~placed, axis=1)
    spheres = quiet.info["spheres"].replace(placed=placed, missing=missing)
    after = far.step(quiet.replace(info=quiet.info | {"spheres": spheres}), REST)
    np.testing.assert_array_equal(
        after.metrics["unplaced_obstacles"], [0, 1, 2, 0, 0, 0, 0, 0]
    )


def test_spheres_that_move_bounce_inside_their_box(make):
    """Against constant speed folded into the box: 1e-4 m after 400 physics steps, the
    rounding of float32 sums; a bounce may overshoot the wall by one step's way."""
    task = make("torques", obstacle_speed=0.4, terminate_on_event=False)
    state = task.reset(jax.random.split(jax.random.key(5), LANES))
    low, high = task.env.sphere_box
    speeds = np.linalg.norm(state.info["spheres"].velocity, axis=-1)
    placed = np.asarray(state.info["spheres"].placed)
    np.testing.assert_allclose(speeds[placed], 0.4, rtol=1e-6)  # float32
    start = np.asarray(state.data.mocap_pos, float)
    velocity = np.asarray(state.info["spheres"].velocity, float)
    placed, centers = np.asarray(state.info["spheres"].placed), start
    for _ in range(40):
        state = task.step(state, REST)
        centers = np.asarray(state.data.mocap_pos)
        assert np.all((centers >= low - 0.0021)[placed])
        assert np.all((centers <= high + 0.0021)[placed])
    span = high - low
    way = (start - low + 2.0 * velocity) % (2 * span)
    folded = low + np.where(way > span, 2 * span - way, way)
    # Each bounce happens up to one step's way behind the wall, 2 mm there and back.
    np.testing.assert_allclose(centers[placed], folded[placed], atol=0.02)


def test_the_controller_is_told_of_the_spheres_late_and_wrongly(make):
    task = make("torques", obstacle_speed=0.4, obstacle_delay=0.1)
    env = task.env
    state = jax.tree.map(
        lambda x: x[0], task.reset(jax.random.split(jax.random.key(5), LANES))
    )
    spheres = state.info["spheres"]
    error = jnp.array([[0.01, 0.0, 0.0], [0.0, -0.02, 0.0]])
    seen = env.obstacles(state.data, spheres, error).spheres
    late = state.data.mocap_pos - 0.1 * spheres.velocity + error
    np.testing.assert_allclose(seen.center, late, atol=1e-6)
    np.testing.assert_array_equal(seen.velocity, spheres.velocity)
    # What is recorded is the truth.
    true = env.gaps(state.data, spheres)
    assert float(env.clearance(state.data, spheres)) == pytest.approx(
        min(float(jnp.min(jnp.where(g.active, g.distance, jnp.inf))) for g in true)
    )


def test_measurement_noise_is_drawn_anew_every_step(make):
    """The noisy controller's trajectory differs from the exact one's, by its key."""
    task = make("rmp_vices", obstacles=2, layout="close", obstacle_noise=0.02)
    keys = jax.random.split(jax.random.key(6), LANES)
    state = task.reset(keys)
    again = state.replace(
        info=state.info | {"rng": jax.random.split(jax.random.key(7), LANES)}
    )
    push = REST.at[:, 6:].set(1.0).at[:, 0].set(1.0)
    for _ in range(10):
        state, again = task.step(state, push), task.step(again, push)
    assert np.any(np.asarray(state.data.qpos) != np.asarray(again.data.qpos))


def test_a_collision_jerks_harder_than_a_fall(close, scripted):
    """The falling lane's jerk before and at its impact; a resting one's beside it."""
    state, action = scripted
    jerk, hit = [], []
    for _ in range(6):
        state = close.step(state, action)
        jerk.append(np.asarray(state.metrics["joint_jerk"]))
        hit.append(bool(state.metrics["collision"][DOWN]))
    first = int(np.argmax(hit))
    assert first > 0 and any(hit)
    before, at = (float(jerk[k][DOWN]) for k in (first - 1, first))
    assert at > 100.0 * before > 0.0
    assert float(jerk[first][-1]) < before  # a lane that rests


def test_smoothness_is_read_from_consecutive_torques():
    tau = np.array([[0, 0], [3, 0], [1, 0], [1.5, 0], [1.2, 5]], float)
    torques, jumps, reversals = Torques.start(2), [], []
    for row in tau:
        torques = torques.then(jnp.asarray(row))
        jumps.append(float(jnp.max(jnp.abs(torques.change))))
        reversals.append(bool(torques.reversed))
    np.testing.assert_allclose(jumps, [0, 3, 2, 0.5, 5])
    # 3 up, 2 down; 0.5 is too little
    assert reversals == [False, False, True, False, False]


def test_jerk_is_the_second_difference_of_the_velocities():
    """Of qd = t^2 and t^3 / 6: 2 and about t, at 5 ms from the second step on."""
    dt, t = 0.005, 0.005 * np.arange(8)
    motion, jerks = Motion.start(jnp.zeros(2)), []
    for row in np.stack([t**2, t**3 / 6], axis=1)[1:]:
        motion = motion.then(jnp.asarray(row, jnp.float32), dt)
        jerks.append(np.asarray(motion.jerk))
    np.testing.assert_array_equal(jerks[0], 0.0)  # there is no step before
    # A velocity of 1e-3 in float32 is good to 1e-10, divided by dt^2.
    np.testing.assert_allclose(np.stack(jerks[1:])[:, 0], 2.0, atol=1e-4)
    np.testing.assert_allclose(np.stack(jerks[1:])[:, 1], t[1:-1], atol=1e-4)


def test_a_guarded_task_counts_what_its_guard_does(make):
    """Random full actions among moving spheres: the guard has to act, its assumptions
    hold while nothing touches, and no first contact begins faster than its speed."""
    task = make("vices", guard=True, layout="close", obstacle_speed=0.1)
    state = task.reset(jax.random.split(jax.random.key(5), LANES))
    used, touched = [], np.zeros(LANES, bool)
    for key in jax.random.split(jax.random.key(6), 40):
        action = jax.random.uniform(key, (LANES, 12), minval=-1.0, maxval=1.0)
        state = task.step(state, jnp.sign(action))
        found = {k: np.asarray(v) for k, v in state.metrics.items()}
        used.append(found["guard_used"])
        assert found["contact_speed"][~touched].max() <= task.env.controller.guard.speed
        touched |= found["contact_force_peak"] > 0.0
        assert np.all(found["guard_unproved"][~touched] == 0.0)
    assert 0.0 < np.mean(used) < 1.0
