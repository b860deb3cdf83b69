"""What the guard asks of a stop, against its documented terms in NumPy.

Distances and rates come from MuJoCo C and differences, the way of a stop from the sum
over its steps. A verdict must change where a term crosses its threshold.
"""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rmp_mjx import Obstacles, Robot, StopGuard
from rmp_mjx.control.guard import FADE, ROUNDING, SLACK, STAGES
from rmp_mjx.robot.configurations import capsule_ends, joint_frames, segment_distance
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state
from tests.oracles import Measured, in_float64, mujoco_terms

STEP, EDGE = 0.005, 1e-6
CENTRE, SLOW = np.array([[0.1, 0.6, 1.2], [0.9, 0.2, 0.3]]), np.array([0.01, 0.0, 0.02])
FAST, WALL, POINT = (
    np.array([0.3, 0.4, 0.0]),
    np.array([0.0, 0.6, 0.8]),
    [0, -1.5, -0.5],
)


def scene():
    """A slow and a fast sphere, the hand may touch one; a wall that comes nearer."""
    slots = Obstacles.empty(spheres=3, planes=1).with_spheres(
        CENTRE, [0.1, 0.05], [SLOW, FAST], hand_may_touch=[False, True]
    )
    return slots.with_planes([POINT], WALL[None], SLOW[None])


@pytest.fixture(scope="module")
def guard(bent):
    """With errors that count, so that no term is too small to be seen."""
    return StopGuard.of(
        bent,
        STEP,
        obstacle_speed=0.1,
        obstacle_error=0.02,
        tolerance=1e-2,
        reserve=0.2,
        limit_margin=0.0,
    )


@pytest.fixture(scope="module")
def judge(bent):
    """`judge(guard, q, v, w, ext, (a, b, lag))`: verdict, stop, bounds; in float64."""

    def both(guard, q, v, w, ext, a, b, lag):
        arm = arm_state(bent, q, v)
        Mq, _ = dynamics(bent, arm)
        found = guard._scene(bent, arm, w, Mq, ext, scene())
        u = a * v + b * w
        Mu = jnp.matmul(Mq, u, precision="highest")
        ways = guard.longest * jnp.array(STAGES) + lag * guard.step
        levers = [guard.bounds.levers(found.levers, u, way) for way in ways]
        return (
            guard._judge(found, a, b, lag),
            guard._stop(found, u, Mu, lag),
            [guard.bounds.torques(bent, R, u) for R in levers],
            Mu,
        )

    return in_float64(both)


@pytest.fixture(scope="module")
def states(bent):
    """Positions, two velocities and contact torques, without self-collision."""
    rng = np.random.default_rng(0)
    middle = np.array([0.0, 0.05, 0.4, -0.3])
    q = middle + rng.uniform(-1, 1, (25, 4)) * [3.0, 0.03, 0.4, 0.4]
    v, w = rng.normal(size=(2, 25, 4)) * [0.3, 0.03, 0.3, 0.3]
    return list(zip(q, v, w, 0.1 * rng.normal(size=(25, 4)), strict=True))


def held(robot, q):
    """The torque that holds the arm at rest, by MuJoCo C."""
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = q
    mujoco.mj_forward(robot.mj_model, data)
    return data.qfrc_bias


CASES = [(0.7, 0.0, 0.0), (0.4, 0.5, 1.0), (0.0, 1.0, 1.0)]


@pytest.mark.parametrize("case", CASES)
def test_a_stop_is_the_shortest_that_the_motors_can_do(
    bent, guard, judge, states, case
):
    """|Mu| / T + B T <= C at every joint, and no more at a thousandth less."""
    lag, tau_max, outcomes = case[2], bent.tau_max, []
    for q, v, w, ext in states:
        _, (T, possible), bounds, Mu = judge(guard, q, v, w, ext, *case)
        u, rest, times = case[0] * v + case[1] * w, held(bent, q) - ext, []
        assert STEP <= T
        for longest, (coriolis, inertia, load) in zip(STAGES, bounds, strict=True):
            room = (1.0 - 0.1 * (1.0 + lag)) * tau_max - guard.damping * np.abs(u)
            room = room - coriolis - 0.5 * inertia - lag * STEP * load
            need = np.abs(Mu) + lag * STEP * inertia

            side = room + np.sign(Mu) * rest + 1e-9
            tried = np.geomspace(STEP, 0.15 * longest, 4000)[:, None]
            can = np.all(need / tried + 0.5 * load * tried <= side, axis=1)
            if not can.any():
                continue
            shortest = tried[can.argmax(), 0]
            left = room - 0.5 * shortest * load + SLACK * tau_max
            moving = np.abs(rest - Mu / shortest) + lag * STEP * inertia / shortest
            if np.all(moving <= left) and np.all(np.abs(rest) <= left):
                times.append(shortest)
        assert possible == bool(times)
        outcomes.append(possible)
        if times:
            np.testing.assert_allclose(T, min(times), rtol=2e-3)
    assert any(outcomes)


def measures(robot, measured, guard, q, u, T, lag):
    """Of every gap: distance left, rate, slip, gain, speed; then those of pairs."""
    h, bounds, size = STEP, guard.bounds, np.abs(u)
    rests = int(np.ceil(T / h - 1e-3))
    way = lag * h + sum(h * (1.0 - k * h / T) for k in range(1, rests))
    steps, products = rests + lag, np.outer(size, size).ravel()

    def loss(bend, lever):
        bend, error = products @ bend, guard.tolerance * steps * lever.sum(axis=1)
        return way * (0.5 * way * bend + error), way * bend + error

    segment = np.array(robot.points.segment)
    hand, radius = segment == 3, np.asarray(robot.points.radius)

    def distances(q):
        x = measured.points(q)
        balls = np.linalg.norm(x - CENTRE[:, None], axis=2) - [[0.1], [0.05]] - radius
        return np.stack([*balls, (x - POINT) @ WALL - radius]) - np.asarray(
            bounds.scallop
        )

    e = 1e-6
    rate = (distances(q + e * u) - distances(q - e * u)) / (2 * e)
    fast = np.array([[max(0.1, np.linalg.norm(SLOW))], [0.5], [np.linalg.norm(SLOW)]])
    left = distances(q) - [[0.02], [0.02], [0.0]] - steps * h * fast
    moved = (measured.points(q + e * u) - measured.points(q - e * u)) / (2 * e)
    (_, R) = joint_frames(robot, np.stack([q - e * u, q + e * u]))
    turn = Rotation.from_matrix(R[:, 1] @ np.swapaxes(R[:, 0], 1, 2)).as_rotvec()
    spin = np.linalg.norm(turn, axis=1) / (2 * e)
    speed = np.linalg.norm(moved, axis=1) + radius * spin[segment]
    slip, gain = (x[segment] for x in loss(bounds.bend, bounds.lever))
    count = np.stack([np.ones_like(hand), ~hand, np.ones_like(hand)])
    gaps = [
        np.broadcast_to(x, left.shape)[count] for x in (left, rate, slip, gain, speed)
    ]

    ends, normals = capsule_ends(robot, q[None], range(len(robot.capsules.geom))), []
    for far, near in robot.capsules.pairs:
        start, end = ends[far]
        shifts = [
            segment_distance(start + s * d, end + s * d, *ends[near])[0]
            for d in np.eye(3)
            for s in (1e-6, -1e-6)
        ]
        normals.append(np.diff(np.reshape(shifts, (3, 2)))[:, 0] / -2e-6)
    return gaps, way, normals, loss(bounds.pair_bend, bounds.pair_lever)


def flips(judge, guard, field, threshold, args, above):
    """Whether the verdict changes as a field crosses a value: it holds on one side."""
    sides = (
        judge(dataclasses.replace(guard, **{field: threshold + s * EDGE}), *args)[0]
        for s in (-1, 1)
    )
    return tuple(map(bool, sides)) == ((False, True) if above else (True, False))


@pytest.mark.parametrize("case", CASES)
def test_the_verdict_changes_where_a_term_crosses_its_threshold(
    bent, guard, judge, states, case
):
    """To a millionth: the margin for the nearest gap or pair, the speed for the fastest
    point, the margin of the joint limits. A dozen stops at least."""
    measured, lag, tried = Measured(bent), case[2], 0
    shy = guard.replace(limit_margin=-9.0)
    for q, v, w, ext in states:
        args = (q, v, w, ext, *case)
        _, (T, possible), *_ = judge(guard, *args)
        if not possible:
            continue
        u = case[0] * v + case[1] * w
        gaps, way, normals, (slip, gain) = measures(bent, measured, guard, q, u, T, lag)
        left, rate, slips, gains, speeds = gaps
        nearest = np.minimum(left, left + way * rate - slips).min()
        ends = capsule_ends(bent, np.stack([q - 1e-6 * u, q, q + 1e-6 * u]), range(6))
        most, rates = [], []
        for i, ((far, near), n) in enumerate(
            zip(bent.capsules.pairs, normals, strict=True)
        ):
            base = carried(bent, near, q, u, far)
            reach = bent.capsules.radius[far] + bent.capsules.radius[near]
            wall = max(x[1] @ n for x in ends[near]) + reach
            for x, still in zip(ends[far], base, strict=True):
                d, r = x[1] @ n - wall, still @ n
                nearest = min(nearest, d, d + way * r - slip[i])
                rates.append((d, r, gain[i]))
            most.append(guard.bounds.pair_lever[i] @ np.abs(u) + gain[i])
        margin = nearest - ROUNDING * lag
        assert flips(judge, shy.replace(speed=0.0), "margin", margin, args, False)
        inside = shy.replace(margin=9.0)
        every = [*zip(left, rate, gains, strict=True), *rates]
        gentle = all(r >= -max(d, 0.0) / FADE for d, r, _ in every) or lag == 0.0
        fastest = max(*(speeds + gains), *most)
        if gentle:
            assert flips(judge, inside, "speed", fastest, args, True)
        else:
            assert not judge(inside.replace(speed=9.0), *args)[0]
        end = q + way * u
        rooms = np.where(u < 0, end - bent.q_lower, bent.q_upper - end)
        room = rooms[np.abs(u) > guard.tolerance].min(initial=np.inf)
        calm = guard.replace(margin=-9.0)
        if np.isfinite(room):
            edge = room - ROUNDING * lag
            assert flips(judge, calm, "limit_margin", edge, args, False)
        tried += 1
    assert tried >= 12


def carried(robot, near, q, u, far):
    """Velocities of the far capsule's ends relative to the near link, at velocity u."""
    e, joint = 1e-6, robot.capsules.segment[near]
    local = []
    for way in (-e, e):
        p, R = joint_frames(robot, (q + way * u)[None])
        ends = capsule_ends(robot, (q + way * u)[None], [far])[far]
        p0, R0 = (np.zeros(3), np.eye(3)) if joint < 0 else (p[joint, 0], R[joint, 0])
        local.append([R0.T @ (x[0] - p0) for x in ends])
    _, R = joint_frames(robot, q[None])
    turn = np.eye(3) if joint < 0 else R[joint, 0]
    return np.array([turn @ d for d in np.subtract(local[1], local[0]) / (2 * e)])


@pytest.mark.parametrize("compensated", [False, True])
def test_the_velocity_expected_of_a_step_is_mujocos(compensated):
    """Of a torque that passes and of a stop, with a contact, float64: 1e-9 rad/s. The
    Jaco 2 has damping, which the bias holds or not. A stop that has begun goes on
    evenly, if the motors can."""
    robot = Robot.load(compensate_passive=compensated)
    guard, rng = StopGuard.of(robot, STEP), np.random.default_rng(0)
    lax = guard.replace(margin=-9.0, speed=9.0, limit_margin=-9.0)
    strict = guard.replace(margin=9.0, speed=0.0)

    def both(guard, q, v, tau, ext):
        arm = arm_state(robot, q, v)
        Mq, bias = dynamics(robot, arm)
        sent, found = guard(robot, arm, tau, Mq, bias, scene(), ext)
        found["T"] = guard._stop(
            guard._scene(robot, arm, v, Mq, ext, scene()),
            v,
            jnp.matmul(Mq, v, precision="highest"),
            0.0,
        )[0]
        return sent, found

    run = jax.jit(both)
    data = mujoco.MjData(robot.mj_model)
    robot.mj_model.opt.timestep = STEP
    for _ in range(8):
        q, v = robot.q_home + rng.uniform(-0.2, 0.2, 7), rng.normal(scale=0.1, size=7)
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(robot.mj_model, data)
        tau, ext = data.qfrc_bias + 0.2 * rng.normal(size=7), 0.05 * rng.normal(size=7)
        for one, used in ((lax, 0.0), (strict, 1.0)):
            with jax.enable_x64(True):
                sent, found = jax.device_get(run(one, q, v, tau, ext))
            assert found["guard_used"] == used
            if not used:
                np.testing.assert_array_equal(sent, tau)
            data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, sent
            data.qfrc_applied[:] = ext
            mujoco.mj_step(robot.mj_model, data)
            np.testing.assert_allclose(data.qvel, found["guard_qd"], atol=1e-9)
            if used:
                expected = (1.0 - STEP / found["T"]) * v
                np.testing.assert_allclose(data.qvel, expected, atol=1e-9)


def test_as_much_of_a_torque_is_sent_as_passes(bent, guard, judge, states):
    """The first of the shares whose blend with the stop keeps clear, at many margins;
    without any the stop, which is proved if the last step left one."""
    shy, seen = guard.replace(limit_margin=-9.0, speed=0.0), set()

    def both(guard, q, v, tau):
        arm = arm_state(bent, q, v)
        Mq, bias = dynamics(bent, arm)
        return guard(bent, arm, bias + tau, Mq, bias, scene())[1]

    run, none = jax.jit(both), np.zeros(4)
    for q, v, push, _ in states[:8]:
        Mq = mujoco_terms(bent.mj_model, "tip", q[None], v[None]).Mq[0]
        w = v + STEP * np.linalg.solve(Mq, 20.0 * push)
        _, (T, _), *_ = judge(shy, q, v, w, none, 1.0, 0.0, 0.0)
        kept = max(1.0 - STEP / T, 0.0)
        for margin in np.linspace(-0.1, 0.6, 80):
            one = shy.replace(margin=margin)
            passes = [
                s
                for s in guard.blends
                if judge(one, q, v, w, none, (1.0 - s) * kept, s, 1.0)[0]
            ]
            stands = bool(judge(one, q, v, w, none, 1.0, 0.0, 0.0)[0])
            with jax.enable_x64(True):
                found = jax.device_get(run(one, q, v, 20.0 * push))
            part = passes[0] if passes else 0.0
            np.testing.assert_allclose(found["guard_used"], 1.0 - part)
            assert found["guard_verified"] == float(bool(passes) or stands)
            assert found["guard_assumptions"] == float(not stands)
            expected = (1.0 - part) * kept * v + part * w
            np.testing.assert_allclose(found["guard_qd"], expected, atol=1e-12)
            seen.add((part, stands))
    assert len({part for part, _ in seen}) >= 3 and len({x for _, x in seen}) == 2


def test_the_default_guard_has_the_numbers_that_its_runs_were_made_with(bent):
    guard = StopGuard.of(bent)
    assert (guard.step, guard.speed, guard.margin) == (0.005, 0.05, 0.001)
    assert (guard.limit_margin, guard.tolerance) == (0.105, 1e-4)
    assert (guard.obstacle_speed, guard.obstacle_error) == (0.0, 0.0)
    assert (guard.reserve, guard.longest, guard.blends) == (0.05, 0.15, (1.0, 0.5, 0.2))
    assert (FADE, STAGES, ROUNDING, SLACK) == (0.5, (0.2, 1.0), 1e-5, 1e-3)
    assert not guard.leaving
