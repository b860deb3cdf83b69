"""The observer against the torque that MuJoCo's own contacts and pushes exert."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy import signal

from rmp_mjx import Robot
from rmp_mjx.control.observer import ContactObserver
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state
from tests import oracles

DT = 0.005
"""Control step of the tasks [s]."""
STEPS = 400
ONSET, RELEASE = 100, 300
"""Steps at which the script pushes the hand down, and at which it lets go."""


class Run(NamedTuple):
    """What was measured before every step, and what acted during it."""

    q: np.ndarray
    qd: np.ndarray
    tau: np.ndarray
    acted: np.ndarray
    """Torque of contacts, limits and pushes (MuJoCo's own), (steps, n) [N m]."""


def simulate(model, q, torque, push=lambda time: 0.0, steps=STEPS) -> Run:
    """Roll out in MuJoCo C under `torque(data)`, with `push(time)` on the joints."""
    data, rows = mujoco.MjData(model), []
    data.qpos[:] = q
    low, high = model.actuator_ctrlrange.T
    for _ in range(steps):
        mujoco.mj_forward(model, data)
        tau = np.clip(torque(data), low, high)
        data.ctrl[:], data.qfrc_applied[:] = tau, push(data.time)
        before = data.qpos.copy(), data.qvel.copy()
        mujoco.mj_step(model, data)
        acted = data.qfrc_constraint + data.qfrc_applied
        rows.append((*before, tau, acted))
    return Run(*(np.array(column) for column in zip(*rows, strict=True)))


def on_a_table(robot):
    """The arm over a table that it can touch."""
    spec = robot.mj_spec
    plane = spec.worldbody.add_geom(name="table", pos=[0.0, 0.0, -0.112])
    plane.type, plane.size = mujoco.mjtGeom.mjGEOM_PLANE, [1.0, 1.0, 0.1]
    return spec.compile()


def press(model):
    """A script: hold, press the hand down with 40 N, hold again, always damped."""
    jacobian, site = np.zeros((3, model.nv)), model.site("grip").id

    def torque(data):
        mujoco.mj_jacSite(model, data, jacobian, None, site)
        pressing = ONSET * DT <= data.time < RELEASE * DT
        return data.qfrc_bias - 3.0 * data.qvel - 40.0 * pressing * jacobian[2]

    return torque


@jax.jit
@lambda f: jax.vmap(f, in_axes=(None, 0, 0))
def _terms(robot, q, qd):
    return dynamics(robot, arm_state(robot, q, qd))


@jax.jit
def _estimates(observer, qd, Mq, bias, tau, dt):
    def step(memory, row):
        qd, *model = row
        out, memory = observer.estimate(memory, qd, dt)
        return memory.then(*model), out

    start = observer.start(qd.shape[1])
    return jax.lax.scan(step, start, (qd, Mq, bias, tau))[1]


def estimates(robot, run, dt=DT, dtype: Any = np.float32, **options):
    """What the observer says before every step, (steps, n), fed as an arm would."""
    observer = ContactObserver.of(robot, **options)
    with jax.enable_x64(dtype == np.float64):
        q, qd, tau = (x.astype(dtype) for x in (run.q, run.qd, run.tau))
        Mq, bias = _terms(robot, q, qd)
        return np.asarray(_estimates(observer, qd, Mq, bias, tau, dt))


@pytest.fixture(scope="module", autouse=True)
def _fresh_caches():
    """JAX may keep a constant in the precision of an earlier module's trace."""
    jax.clear_caches()


@pytest.fixture(scope="module")
def pressed(robot):
    """The hand pressed on a table and let go."""
    model = on_a_table(robot)
    return simulate(model, robot.q_home, press(model))


@pytest.fixture(scope="module")
def kicked(robot):
    """Torques that jump every 50 ms, (steps, n) [N m]."""
    kicks = np.random.default_rng(0).normal(scale=0.2, size=(STEPS // 10, 7))
    return np.repeat(kicks * robot.tau_max, 10, axis=0)


def swing(robot, kicked, **options):
    """Free motion under those torques, and the estimates."""
    model = robot.mj_model
    model.geom_contype[:] = 0
    model.jnt_limited[:] = 0
    torque = lambda data: data.qfrc_bias + kicked[round(data.time / DT)]  # noqa: E731
    run = simulate(model, robot.q_home, torque)
    return run, estimates(robot, run, **options)


def test_nothing_is_felt_in_free_motion(robot, kicked):
    """At up to 25 rad/s, where float32 rounds qd by 1e-6, times Mq / h of 100."""
    run, single = swing(robot, kicked)
    assert np.abs(run.qd).max() > 20.0
    assert not np.any(run.acted)
    assert np.median(np.abs(single).max(axis=1)) < 2e-5
    assert np.abs(single).max() < 2e-4
    double = estimates(robot, run, dtype=np.float64)
    np.testing.assert_allclose(double, 0.0, atol=1e-11)


def test_the_one_step_form_is_the_engines_torque_one_step_late(robot, pressed):
    """An impact of 175 N m and 40 N at rest: rounding, relative to the impact."""
    assert np.abs(pressed.acted).max() > 100.0
    assert np.abs(pressed.acted[RELEASE - 50]).max() > 5.0
    for dtype, error in ((np.float32, 5e-5), (np.float64, 1e-11)):
        felt = estimates(robot, pressed, dtype=dtype)
        np.testing.assert_array_equal(felt[0], 0.0)
        np.testing.assert_allclose(felt[1:], pressed.acted[:-1], rtol=0.0, atol=error)


@pytest.mark.parametrize("armature", ["robosuite", "physical"])
@pytest.mark.parametrize("compensated", [True, False])
def test_friction_and_rotors_are_the_models_own(armature, compensated, kicked):
    """Whether the controllers make up for the joints' damping or not."""
    robot = Robot.load(armature=armature, compensate_passive=compensated)
    assert (robot.damping is not None) == compensated
    _, felt = swing(robot, kicked, dtype=np.float64)
    np.testing.assert_allclose(felt, 0.0, atol=1e-11)


def test_dry_friction_is_no_contact_while_the_joint_turns(robot):
    """2 N m on joint 1, which is driven round; felt only where its sense changes."""
    spec = robot.mj_spec
    spec.joint("joint_1").frictionloss = 2.0
    with pytest.warns(match="dry friction"):
        stiff = Robot.from_mjcf(spec, site="grip", q_home=robot.q_home)
    model = stiff.mj_model

    def torque(data):
        wave = np.sin(4.0 * data.time)
        return data.qfrc_bias + 8.0 * wave * np.eye(7)[0] - 2.0 * data.qvel

    run = simulate(model, stiff.q_home, torque)
    np.testing.assert_allclose(np.abs(run.acted).max(), 2.0, rtol=1e-3)
    turning = np.abs(run.qd[:, 0]) > 0.05
    assert turning.mean() > 0.5
    felt = estimates(stiff, run, dtype=np.float64)[:, 0]
    assert np.abs(felt[turning]).max() < 0.01
    ignorant = estimates(robot, run, dtype=np.float64)[:, 0]
    np.testing.assert_allclose(np.abs(ignorant[turning]), 2.0, atol=0.3)


@pytest.mark.parametrize("gain", [25.0, 100.0])
def test_the_momentum_form_is_a_low_pass_of_the_engines_torque(robot, pressed, gain):
    """scipy's filter with a pole at exp(-K h), one step late; double precision."""
    a = 1.0 - np.exp(-gain * DT)
    expected = signal.lfilter([a], [1.0, a - 1.0], pressed.acted[:-1], axis=0)
    felt = estimates(robot, pressed, gain=gain, dtype=np.float64)
    np.testing.assert_allclose(felt[1:], expected, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("gain", [25.0, 100.0])
def test_a_steady_push_is_felt_to_63_per_cent_after_one_over_the_gain(robot, gain):
    """And to 99 % after 4.6/K; steps of 1 ms, held by the script's own damping."""
    dt, begin = 1e-3, 0.1
    model = robot.mj_model
    model.opt.timestep, model.geom_contype[:] = dt, 0
    hand = np.array([0.0, 5.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    run = simulate(
        model,
        robot.q_home,
        lambda data: data.qfrc_bias - 5.0 * data.qvel,
        lambda time: hand * (time >= begin),
    )
    share = estimates(robot, run, dt, gain=gain)[:, 1] / 5.0
    for part in (0.632, 0.99):
        delay = dt * np.argmax(share > part) - begin
        assert delay == pytest.approx(-np.log(1.0 - part) / gain, abs=1.5 * dt)


def textbook(robot, run, gain, dt, path):
    """r = K (p - int(tau + C' qd - g - d + r) dt - p0) with Pinocchio's C, g and M."""
    pin = pytest.importorskip("pinocchio")
    path.write_text(robot.mjcf)
    model = pin.buildModelFromMJCF(str(path))
    data, damping = model.createData(), robot.mj_model.dof_damping
    integral, r, rows, start = np.zeros(7), np.zeros(7), [], None
    for q, qd, tau, _ in zip(*run, strict=True):
        pin.computeAllTerms(model, data, q, qd)
        p = (np.triu(data.M) + np.triu(data.M, 1).T) @ qd
        start = p if start is None else start
        r = gain * (p - integral - start)
        rows.append(r)
        C, g = pin.computeCoriolisMatrix(model, data, q, qd), data.g
        integral = integral + dt * (tau + C.T @ qd - g - damping * qd + r)
    return np.array(rows)


def test_the_momentum_form_is_the_momentum_observer(robot, tmp_path):
    """As the time step falls: the difference halves with it, from 1 % of the torque.

    The arm swings at up to 5 rad/s while two joints are pushed by 6 N m.
    """
    gain, differences = 50.0, []
    sides = np.array([6.0, 0.0, -6.0, 0.0, 0.0, 0.0, 0.0])
    swings = np.array([9.0, 9.0, 7.0, 7.0, 5.0, 1.0, 1.0])
    for dt in (4e-4, 2e-4):
        model = robot.mj_model
        model.opt.timestep, model.geom_contype[:] = dt, 0
        run = simulate(
            model,
            robot.q_home,
            lambda data: data.qfrc_bias + swings * np.cos(9.0 * data.time),
            lambda time: sides * np.sin(20.0 * time),
            steps=round(0.4 / dt),
        )
        ours = estimates(robot, run, dt, gain=gain, dtype=np.float64)
        book = textbook(robot, run, gain, dt, tmp_path / "arm.xml")
        assert np.abs(ours).max() > 4.0
        differences.append(np.abs(ours - book).max())
    assert differences[0] < 0.06
    assert differences[1] == pytest.approx(0.5 * differences[0], rel=0.1)


def test_noise_of_the_velocities_is_as_large_as_stated(robot):
    """An arm at rest, 20,000 steps: 3 % of the standard deviation."""
    n, size = 7, 20_000
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = robot.q_home
    Mq = oracles.mujoco_terms(robot.mj_model, "grip", data.qpos[None], np.zeros((1, n)))
    Mq = Mq.Mq[0].astype(np.float32)
    noise = 0.01 * np.random.default_rng(0).normal(size=(size, n)).astype(np.float32)
    rest = np.zeros((size, n), np.float32)
    matrices = np.broadcast_to(Mq, (size, n, n))
    for gain in (None, 50.0):
        observer = ContactObserver(gain=gain)
        felt = np.asarray(_estimates(observer, noise, matrices, rest, rest, DT))[100:]
        a = 1.0 if gain is None else 1.0 - np.exp(-gain * DT)
        expected = 0.01 / DT * np.sqrt(2.0 * a**2 / (2.0 - a))
        expected = expected * np.linalg.norm(Mq, axis=1)
        np.testing.assert_allclose(felt.std(axis=0), expected, rtol=0.03)


def test_a_delay_shifts_the_estimates_by_whole_steps(robot, pressed):
    assert ContactObserver().delay == ContactObserver.of(robot).delay == 0
    now = estimates(robot, pressed, gain=100.0)
    late = estimates(robot, pressed, gain=100.0, delay=3)
    np.testing.assert_array_equal(late[:3], 0.0)
    np.testing.assert_array_equal(late[3:], now[:-3])


def test_a_dead_band_takes_its_width_off(robot, pressed):
    raw = estimates(robot, pressed)
    cut = estimates(robot, pressed, dead_band=np.float32(1.5))
    np.testing.assert_array_equal(cut[np.abs(raw) <= 1.5], 0.0)
    over = np.abs(raw) > 1.5
    expected = raw - 1.5 * np.sign(raw)
    np.testing.assert_allclose(cut[over], expected[over], rtol=1e-6)


def test_batches_are_loops_and_gradients_are_finite(robot, pressed):
    """Two arms at once, one of them just started, differentiated by everything."""
    observer = ContactObserver.of(robot, gain=100.0, dead_band=0.1, delay=1)
    k = RELEASE - 50
    qd, tau = (np.stack([x[k], x[k + 1]]).astype(np.float32) for x in pressed[1:3])
    Mq, bias = _terms(robot, np.stack([robot.q_home] * 2).astype(np.float32), qd)
    fresh = observer.start(7)
    one = fresh.replace(qd=jnp.ones(7)).then(Mq[0], bias[0], jnp.asarray(tau[0]))
    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), one, fresh)

    def felt(observer, memory, qd, dt):
        out, memory = observer.estimate(memory, qd, dt)
        return jnp.concatenate([out, memory.tau_ext])

    batched = jax.vmap(felt, (None, 0, 0, None))(observer, both, qd, DT)
    for lane, memory in enumerate((one, fresh)):
        alone = felt(observer, memory, qd[lane], DT)
        np.testing.assert_allclose(batched[lane], alone, rtol=1e-6)
    np.testing.assert_array_equal(batched[1], 0.0)
    for memory in (one, fresh):
        slope = jax.grad(
            lambda *x: jnp.sum(felt(*x) ** 2), (0, 1, 2, 3), allow_int=True
        )
        for leaf in jax.tree.leaves(slope(observer, memory, qd[0], DT)):
            assert leaf.dtype == jax.dtypes.float0 or np.all(np.isfinite(leaf))
