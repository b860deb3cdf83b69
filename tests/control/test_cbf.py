"""The safety filter against an exact solver, on an arm that compiles fast."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx import VICES, Obstacles, Robot
from rmp_mjx.control.cbf import project
from rmp_mjx.robot.configurations import capsule_gaps
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state
from tests import oracles
from tests.robot.test_model import GRIPPER

clarabel = pytest.importorskip("clarabel")

from rmp_mjx.control import cbf  # noqa: E402

STATES = 64
BALL = np.array([[0.35, 0.1, 0.45], [0.2, -0.2, 0.5]])


@pytest.fixture(scope="module")
def filtered():
    return cbf.FilteredVICES(Robot.from_mjcf(GRIPPER, site="tip", spacing=0.1))


@pytest.fixture(scope="module")
def states():
    rng = np.random.default_rng(0)
    return (
        rng.uniform(-1.0, 1.0, (STATES, 3)),
        rng.normal(size=(STATES, 3)),
        rng.uniform(-1.0, 1.0, (STATES, 12)),
    )


def slots():
    plane = np.array([[0.0, 0.0, 1.0]])
    empty = Obstacles.empty(spheres=3, planes=1)
    return empty.with_spheres(BALL, 0.05).with_planes(0.0 * plane, plane)


@pytest.fixture(scope="module")
def run(filtered, states):
    """Output, VICES' acceleration, barriers and dynamics in all states, float32."""

    @jax.jit
    def every(q, qd, action):
        def one(q, qd, action):
            setpoint = filtered.setpoint(q, filtered.decode(action), 0.0)
            arm = arm_state(filtered.robot, q, qd)
            return (
                filtered(q, qd, setpoint, slots()),
                wanted(VICES(filtered.robot)(q, qd, setpoint, slots()), arm),
                filtered.barriers(arm, q, qd, slots()),
                dynamics(filtered.robot, arm),
            )

        def wanted(out, arm):
            Mq, bias = dynamics(filtered.robot, arm)
            return jax.numpy.linalg.solve(Mq, out.tau - bias)

        return jax.vmap(one)(q, qd, action)

    return jax.device_get(every(*(np.float32(x) for x in states)))


def exact(ctrl, wanted, barriers, Mq, bias):
    """The soft program by Clarabel, in joint accelerations."""
    on = barriers.active
    alpha = ctrl.rate
    need = barriers.drift + 2 * alpha * barriers.rate + alpha**2 * barriers.distance
    tau_max = np.asarray(ctrl.robot.tau_max, float)
    G = np.concatenate([-barriers.rows[on], Mq, -Mq]).astype(float)
    h = np.concatenate([need[on], tau_max - bias, tau_max + bias]).astype(float)
    length = np.linalg.norm(np.linalg.solve(np.linalg.cholesky(Mq), G.T), axis=0)
    movable = length > cbf.FREE
    G, h, length = G[movable], h[movable], length[movable]
    most = cbf.LARGEST * length
    h = G @ wanted + np.clip(h - G @ wanted, -most, most)
    Mq = Mq.astype(float)
    # Violations in units of the scaled rows.
    return oracles.soft_program(clarabel, Mq, -Mq @ wanted, G, h, length, ctrl.penalty)


def distance(Mq, gap):
    """Norm of differences of accelerations in the inertia [sqrt(kg m^2) rad/s^2]."""
    return np.sqrt(np.einsum("bi,bij,bj->b", gap, Mq, gap))


def test_the_program_is_solved_as_by_clarabel(filtered, run):
    """Within 1e-4 in the median and 2e-3 of the change in all states, changes being
    tens of sqrt(kg m^2) rad/s^2: float32, with a condition of 1e3 by the penalty."""
    out, vices, barriers, (Mq, bias) = run
    assert out.diagnostics["solved"].all()
    qdd = np.array(
        [
            exact(
                filtered,
                vices[k].astype(float),
                cbf.Barriers(*(x[k] for x in barriers)),
                Mq[k],
                bias[k],
            )
            for k in range(STATES)
        ]
    )
    error = distance(Mq, out.qdd - qdd)
    change = distance(Mq, qdd - vices)
    assert (change > 1.0).sum() > 10
    assert np.median(error) < 1e-4 and (error < 2e-3 * (1.0 + change)).all()


def test_barriers_are_distances_and_their_time_derivatives(filtered, states):
    """Against differences along q + t qd: the rate and, with qdd = 0, the drift.

    1e-5 relative to the largest: second differences of float64 at a step of 1e-4.
    """
    step = 1e-4

    @jax.jit
    def at(q, qd):
        def one(q, qd):
            arm = arm_state(filtered.robot, q, qd)
            return filtered.barriers(arm, q, qd, slots())

        return jax.vmap(one)(q, qd)

    with jax.enable_x64(True):
        q, qd, _ = states
        moved = [at(q + t * qd, qd) for t in (-step, 0.0, step)]
        off = [at(q + step * np.eye(3)[j], qd).distance for j in range(3)]
        (before, now, after), off = jax.device_get((moved, off))
    on = now.active[0]
    assert on.sum() > 40
    rate = (after.distance - before.distance) / (2 * step)
    np.testing.assert_allclose(
        now.rate[:, on], rate[:, on], atol=1e-5 * np.abs(rate).max()
    )
    drift = (after.rate - before.rate) / (2 * step)
    np.testing.assert_allclose(
        now.drift[:, on], drift[:, on], atol=1e-4 * np.abs(drift).max()
    )
    slope = np.stack([(x - now.distance) / step for x in off], axis=-1)
    np.testing.assert_allclose(now.rows[:, on], slope[:, on], atol=1e-2)


def test_where_nothing_is_near_it_is_vices(filtered, run):
    """Wherever VICES' own acceleration keeps every barrier and torque limit: the
    program's start is its solution, up to float32's error in the torque."""
    out, vices, barriers, (Mq, _) = run
    need = barriers.drift + 2 * filtered.rate * barriers.rate
    need = need + filtered.rate**2 * barriers.distance
    room = need + np.einsum("bmn,bn->bm", barriers.rows, vices)
    free = (room > 0.0).all(1, where=barriers.active)
    assert free.sum() > 2
    error = distance(Mq[free], (out.qdd - vices)[free])
    assert error.max() < 1e-2


def one_barrier(distance, rate, drift, row, count=1):
    """The same barrier several times."""
    return cbf.Barriers(
        jnp.full(count, distance),
        jnp.full(count, rate),
        jnp.full(count, drift),
        jnp.tile(jnp.array(row), (count, 1)),
        jnp.ones(count, bool),
    )


def change_of(filtered, barriers, wanted):
    """The filtered acceleration of three masses of 1 kg m^2, (3,)."""
    return filtered._filter(wanted, barriers, jnp.eye(3), jnp.zeros(3))[0]


def test_a_distance_is_kept_with_both_poles_at_10_per_second(filtered):
    """x = -need up to the penalty of a thousand, 300 at most; rows have no length.
    Shorter ones than 1e-3 do not count. 1e-5: float32."""
    soft, still, change = 1000.0 / 1001.0, np.zeros(3, np.float32), jax.jit(change_of)
    for distance, rate, drift in ((0.01, -0.1, -0.5), (-0.02, 0.02, 0.1)):
        need = drift + 20.0 * rate + 100.0 * distance
        assert need < 0.0
        barrier = one_barrier(distance, rate, drift, [0.0, 2.0, 0.0])
        qdd = change(filtered, barrier, still + np.float32(0.2))
        over = soft * (-need / 2.0 - 0.2)
        np.testing.assert_allclose(qdd, [0.2, 0.2 + over, 0.2], rtol=1e-5)
    for most, expected in ((299.0, 299.0), (301.0, 300.0)):
        strong = filtered.replace(robot=filtered.robot.replace(tau_max=np.full(3, 1e4)))
        barrier = one_barrier(0.0, 0.0, -most, [1.0, 0.0, 0.0])
        qdd = change(strong, barrier, still)
        np.testing.assert_allclose(qdd[0], soft * expected, rtol=1e-5)
    for length, counts in ((0.99e-3, False), (1.01e-3, True)):
        barrier = one_barrier(0.0, 0.0, -1e-3, [length, 0.0, 0.0])
        qdd = change(filtered, barrier, still)
        assert (qdd[0] > 0.0) == counts


def test_48_constraints_are_in_the_program(filtered, monkeypatch):
    """Or all that there are: six are the torque limits."""
    sizes = []

    def solved(G, h, penalty):
        sizes.append(G.shape[1])
        return jnp.zeros(len(G)), jnp.ones(())

    monkeypatch.setattr(cbf, "project", solved)
    for count in (30, 60):
        barriers = one_barrier(1.0, 0.0, 0.0, [1.0, 0.0, 0.0], count)
        jax.eval_shape(change_of, filtered, barriers, jnp.zeros(3))
    assert sizes == [36, 48]


def test_margins_are_5_mm_and_a_twelfth_of_a_radian_and_more(bent):
    """Distances by NumPy, less 5 mm; room to the joints' limits, less 0.12. A joint
    without limits has none. 1e-6: float32."""
    ctrl, q = cbf.FilteredVICES(bent), bent.q_ref + 0.1

    @jax.jit
    def barriers(q):
        arm = arm_state(bent, q, jnp.zeros(4))
        return ctrl.barriers(arm, q, arm.qd, Obstacles.empty())

    found = barriers(np.float32(q))
    pairs = len(bent.capsules.pairs)
    gaps = capsule_gaps(bent, q[None], bent.capsules.pairs)[0]
    np.testing.assert_allclose(found.distance[:pairs], gaps - 0.005, atol=1e-6)
    room = np.concatenate([q - bent.q_lower, bent.q_upper - q])
    active = np.asarray(found.active[pairs:])
    np.testing.assert_array_equal(active, np.isfinite(room))
    np.testing.assert_allclose(
        found.distance[pairs:][active], room[active] - 0.12, atol=1e-6
    )


clarabel = pytest.importorskip("clarabel")

N, M, BATCH, PENALTY = 7, 48, 64, 1e3


@pytest.fixture(scope="module")
def programs():
    """Half-spaces with unit normals; some of the first cannot all hold."""
    rng = np.random.default_rng(0)
    G = rng.normal(size=(BATCH, N, M))
    h = rng.uniform(0.0, 300.0, (BATCH, M))
    h[:, :4] -= 200.0
    return G / np.linalg.norm(G, axis=1, keepdims=True), h


def test_projections_are_clarabels(programs):
    """Relative to changes of some hundreds: 1e-4, float32 with a condition of 1e3."""
    G, h = programs
    solve = jax.jit(jax.vmap(lambda G, h: project(G, h, PENALTY)))
    x, solved = jax.device_get(solve(jnp.float32(G), jnp.float32(h)))
    assert solved.all()
    soft = partial(oracles.soft_program, clarabel, np.eye(N), np.zeros(N))
    wanted = np.array([soft(G[k].T, h[k], np.ones(M), PENALTY) for k in range(BATCH)])
    size = np.linalg.norm(wanted, axis=1)
    assert np.median(size) > 10.0
    assert np.linalg.norm(x - wanted, axis=1).max() < 1e-4 * size.max()


def test_the_origin_is_kept_where_it_is_inside(programs):
    G, h = programs
    x, solved = project(jnp.float32(G[0]), jnp.abs(jnp.float32(h[0])), PENALTY)
    assert solved == 1.0 and (x == 0.0).all()


def test_it_says_where_it_gave_up():
    _, solved = project(jnp.full((2, 3), jnp.nan), jnp.zeros(3), PENALTY)
    assert solved == 0.0
