"""The root under limits against Clarabel, and as a function that JAX transforms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmp_mjx import RMPVICES, Obstacles, Robot
from rmp_mjx.control.root import Rows, solve_root
from rmp_mjx.math import psd_solve
from rmp_mjx.robot.errors import RobotError
from tests.robot.test_model import GRIPPER

N = 7


@jax.jit
@jax.vmap
def limited(H, f, Mq, bias, tau_max):
    """Torque, acceleration and rows at their ends, for many states."""
    qdd, at_end = solve_root(H, f, Rows.hard(Mq, -tau_max - bias, tau_max - bias))
    return jnp.matmul(Mq, qdd, precision="highest") + bias, qdd, at_end


@jax.jit
@jax.vmap
def free(H, f):
    return psd_solve(H, f)


@pytest.fixture(scope="module")
def hard_states(run64, ctrl, states, obstacles):
    """Roots of 10,000 states of the arm: overlaps, fast joints, weak motors."""
    found = []
    for seed in range(20):
        reach, speed = (1.0, 1.0) if seed % 2 else (0.5, 0.3)
        out = run64(ctrl, *states(seed, reach, speed), obstacles(seed))
        H = out.M + ctrl.regularizer * out.Mq
        found.append((H, out.f, out.Mq, out.bias))
    H, f, Mq, bias = (np.concatenate(x) for x in zip(*found, strict=True))
    share = np.random.default_rng(0).uniform(0.2, 1.0, (len(H), 1))
    return H, f, Mq, bias, share * ctrl.robot.tau_max


def test_torque_is_clarabels_in_10_000_states(hard_states):
    """1e-4 of the limits: Clarabel's own tolerance times the root's condition; float64.

    All but a few are within 1e-6.
    """
    clarabel = pytest.importorskip("clarabel")
    from scipy import sparse

    with jax.enable_x64(True):
        tau, _, at_end = jax.device_get(limited(*hard_states))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-12
    errors, saturated = [], np.zeros(N + 1, int)
    for k, (H, f, Mq, bias, tau_max) in enumerate(zip(*hard_states, strict=True)):
        saturated[np.sum(at_end[k] != 0.0)] += 1
        if not at_end[k].any():
            continue
        # In torques over their limits: the box is the unit cube.
        lift = np.linalg.solve(Mq, np.diag(tau_max))
        shift = -np.linalg.solve(Mq, bias)
        P = lift.T @ H @ lift
        scale = np.trace(P)
        cost = lift.T @ (H @ shift - f) / scale
        P = sparse.csc_matrix(np.triu(0.5 * (P + P.T)) / scale)
        G = sparse.csc_matrix(np.concatenate([np.eye(N), -np.eye(N)]))
        cones = [clarabel.NonnegativeConeT(2 * N)]
        problem = clarabel.DefaultSolver(P, cost, G, np.ones(2 * N), cones, settings)
        theirs = np.array(problem.solve().x)
        errors.append(np.max(np.abs(tau[k] / tau_max - theirs)))
    assert max(errors) < 1e-4
    assert np.quantile(errors, 0.99) < 1e-6
    assert saturated.sum() == 10_000
    assert (saturated > 100).all(), "any number of joints is at its limit in some"


def test_solution_in_float32_is_that_of_float64(hard_states):
    """Half within 1e-4 of the limit, 99 % within 10 %: the root's condition is 1e6."""
    with jax.enable_x64(True):
        double, *_ = jax.device_get(limited(*hard_states))
    single, *_ = jax.device_get(limited(*(x.astype(np.float32) for x in hard_states)))
    error = np.max(np.abs(single - double) / hard_states[-1], axis=1)
    assert np.quantile(error, 0.5) < 1e-4
    assert np.quantile(error, 0.99) < 0.1


def test_nothing_changes_while_no_joint_is_at_its_limit(hard_states):
    """Up to rounding: 1e-9 of the largest entry, float64."""
    H, f, Mq, bias, _ = hard_states
    with jax.enable_x64(True):
        endless = np.full((len(H), N), 1e30)
        _, qdd, at_end = jax.device_get(limited(H, f, Mq, bias, endless))
        expected = jax.device_get(free(H, f))
    largest = np.abs(expected).max(axis=1, keepdims=True)
    assert np.max(np.abs(qdd - expected) / largest) < 1e-9
    assert not at_end.any()


def test_batches_give_what_single_states_give(hard_states):
    """1e-9 of the limits; float64."""
    single = jax.jit(
        lambda *x: solve_root(x[0], x[1], Rows.hard(x[2], -x[4] - x[3], x[4] - x[3]))
    )
    with jax.enable_x64(True):
        batch = jax.device_get(limited(*hard_states))
        for k in range(0, 400, 8):
            H, f, Mq, bias, tau_max = (jnp.asarray(x[k]) for x in hard_states)
            qdd, at_end = jax.device_get(single(H, f, Mq, bias, tau_max))
            tau = Mq @ qdd + bias
            assert np.max(np.abs(tau - batch[0][k]) / tau_max) < 1e-9
            np.testing.assert_array_equal(at_end, batch[2][k])


def test_gradient_is_that_of_differences(hard_states):
    """Central differences, 1e-4 of the largest entry; float64, joints at their limits.

    Both modes agree to rounding.
    """
    with jax.enable_x64(True):
        at_end = np.asarray(limited(*hard_states)[2])
        some = np.flatnonzero((at_end != 0).sum(1) == 2)[:3]
        assert len(some) == 3

        @jax.jit
        def tau(f, scale, H, Mq, bias, tau_max):
            high = scale * tau_max
            rows = Rows.hard(Mq, -high - bias, high - bias)
            return jnp.matmul(Mq, solve_root(H, f, rows)[0]) + bias

        for k in some:
            H, f, Mq, bias, tau_max = (jnp.asarray(x[k]) for x in hard_states)
            rest = (H, Mq, bias, tau_max)
            J = jax.jacfwd(tau)(f, 1.0, *rest)
            back = jax.jacrev(tau)(f, 1.0, *rest)
            np.testing.assert_allclose(J, back, atol=1e-9 * np.abs(J).max(), rtol=0)
            for i in range(N):
                h = 1e-6 * np.abs(f).max() * np.eye(N)[i]
                slope = (tau(f + h, 1.0, *rest) - tau(f - h, 1.0, *rest)) / (2 * h[i])
                np.testing.assert_allclose(
                    J[:, i], slope, rtol=0.0, atol=1e-4 * np.abs(J).max()
                )
            by_limit = jax.jacfwd(tau, 1)(f, 1.0, *rest)
            h = 1e-6
            slope = (tau(f, 1.0 + h, *rest) - tau(f, 1.0 - h, *rest)) / (2 * h)
            np.testing.assert_allclose(by_limit, slope, atol=1e-4 * np.max(tau_max))


# fmt: off
DEEP = [  # H and Mq of an iiwa 14 deep inside a box, their lower triangles by rows
    466.2, 153.7, 223.4, -2.029, -4.921, 0.39, 0.02763, -0.2163, 0.001632, 0.2551,
    0.01898, 0.01006, 0.01775, -0.009586, 0.003345, -0.03535, 0.02938, -0.02732,
    -0.05263, 1.841e-10, 0.01625, -0.0008232, -0.0002535, -0.0003628, 0.0001451,
    0.0008688, 4.37e-09, 0.001585,
    2.526, 0.01564, 2.94, 1.27, 0.17, 0.9746, 0.09346, -0.7429, 0.002272, 0.9574,
    -0.005031, 0.02085, 0.008102, -0.0262, 0.1132, -0.03733, 0.03128, -0.02892,
    -0.05572, -3.837e-07, 0.1168, -0.0008911, -0.0002745, -0.0003928, 0.0001571,
    0.0009405, 5.549e-09, 0.101,
]
# fmt: on


def test_no_root_is_lost_in_float32_where_more_rows_hold_than_joints():
    """Limits of torque and speed, on an arm that a box presses on: 4,000 like it.

    A root that was lost is NaN, or accelerates by more than 1e8 rad/s^2. One in 80 was,
    before the softness of a row bounded its pivot.
    """
    rng, count = np.random.default_rng(0), 4000
    lower = np.zeros((2, N, N))
    lower[:, *np.tril_indices(N)] = np.reshape(DEEP, (2, -1))
    H, Mq = lower + np.tril(lower, -1).swapaxes(1, 2)
    change = np.tril(1e-5 * rng.normal(size=(count, N, N)))
    H = H * (1.0 + change + np.tril(change, -1).swapaxes(1, 2))
    force = np.array([2.314e6, 1.96e6, -3.491e4, 5.477, -0.281, -0.0273, 0.00955])
    f = force * np.exp(0.5 * rng.normal(size=(count, N)))
    high = np.array([320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0])
    bias = np.array([0.4217, -54.94, -2.766, 15.62, -0.5396, -0.2931, -0.0003693])
    most = np.array([83.13, 77.74, 45.45, 54.2, 91.09, 77.03, 81.41])

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, 0, None, None, None, None))
    def root(H, f, Mq, low, high, most):
        torque, speed = Rows.hard(Mq, low, high), Rows.soft(jnp.eye(N), -most, most)
        return solve_root(H, f, Rows.join([torque, speed]))[0]

    given = (H, f, Mq, -high - bias, high - bias, most)
    qdd = np.asarray(root(*(jnp.asarray(x, jnp.float32) for x in given)))
    assert np.all(np.abs(qdd) < 1e8)


entries = st.lists(st.floats(-1.0, 1.0, width=32), min_size=30, max_size=30)


@settings(deadline=None, max_examples=200)
@given(entries, st.floats(0.01, 3.0))
def test_any_small_problem_fulfils_its_optimality_conditions(numbers, room):
    """Gradient zero, multipliers on the right side, rows in range: 1e-4, float32."""
    x = np.array(numbers, np.float32)
    root = x[:9].reshape(3, 3)
    H = root @ root.T + 0.1 * np.eye(3, dtype=np.float32)
    A = x[9:18].reshape(3, 3) + 2.0 * np.eye(3, dtype=np.float32)
    f = 3.0 * x[18:21]
    middle = 0.5 * x[21:24]
    rows = Rows.hard(A, middle - np.float32(room), middle + np.float32(room))
    qdd, at_end = (np.asarray(y) for y in small(H, f, rows))
    t = A @ qdd
    assert np.all(t <= rows.high + 1e-4) and np.all(t >= rows.low - 1e-4)
    lam = np.linalg.solve(A.T, f - H @ qdd)  # H qdd + A' lam = f
    scale = 1e-4 * (1.0 + np.abs(lam).max())
    assert np.all(np.abs(lam[at_end == 0.0]) < scale)
    assert np.all(lam * at_end > -scale)


small = jax.jit(solve_root)


@pytest.fixture(scope="module")
def quick_arm(robot):
    """The Jaco with limits of speed and of the torques' rate."""
    return robot.replace(qd_max=np.full(N, 0.5), tau_rate_max=np.full(N, 200.0))


def test_joints_are_held_below_their_speed(run64, quick_arm, states, obstacles):
    """qd + 5 periods x qdd within 99 % of the speed, where the torque limits allow it.

    The limits of speed are soft: in 90 % of the states 5 % of what the free solution
    exceeds them by, 50 % at most. Arms that touch an obstacle are left out.
    """
    ctrl = RMPVICES(quick_arm)
    q, _, action = states(0, 0.5, 0.0)
    qd = np.random.default_rng(1).uniform(-0.5, 0.5, q.shape)
    out = run64(ctrl, q, qd, action, obstacles(0))
    after = qd + 5 * ctrl.period * out.qdd
    torque, speed = (out.diagnostics[f"{x}_limit"] for x in ("torque", "velocity"))
    can = ~torque.any(axis=1) & (out.diagnostics["clearance"] > 0.01)
    assert can.sum() > 100
    beyond = np.abs(after).max(axis=1) - 0.99 * 0.5
    free = np.linalg.solve(out.M + ctrl.regularizer * out.Mq, out.f[..., None])[..., 0]
    wanted = np.abs(qd + 5 * ctrl.period * free).max(axis=1) - 0.99 * 0.5
    share = beyond[can] / (1e-3 + np.maximum(wanted[can], 0.0))
    assert np.quantile(share, 0.9) < 0.05 and share.max() < 0.5
    assert (speed != 0.0).any(axis=1).mean() > 0.2


def test_torque_changes_by_its_rate_at_most(quick_arm, robot):
    """To the last bit of float32."""

    @jax.jit
    def torque(ctrl, q, last):
        setpoint = ctrl.setpoint(q, ctrl.decode(jnp.ones(12)), 0.0)
        return ctrl(q, 0.0 * q, setpoint, Obstacles.empty(), None, last).tau

    q = jnp.asarray(robot.q_home, jnp.float32)
    slow = np.abs(torque(RMPVICES(quick_arm), q, jnp.zeros(N)))
    assert np.float32(0.999) <= slow.max() <= np.float32(1.0), "200 N m/s x 5 ms"
    assert np.abs(torque(RMPVICES(robot), q, jnp.zeros(N))).max() > 2.0


def test_limits_are_checked_when_a_robot_is_made():
    arm = Robot.from_mjcf(GRIPPER, site="tip", velocity_limits=[1, 2, 3])
    np.testing.assert_array_equal(arm.qd_max, [1.0, 2.0, 3.0])
    with pytest.raises(RobotError, match="velocity_limits must be 3 finite"):
        Robot.from_mjcf(GRIPPER, site="tip", velocity_limits=[1, 2])
    with pytest.raises(RobotError, match="torque_rate_limits must be positive"):
        Robot.from_mjcf(GRIPPER, site="tip", torque_rate_limits=[1, 0, 3])


def test_the_solution_is_finite_where_rounding_takes_the_metrics_definiteness():
    """Four heavy directions of seven, and 1e-5 of an inertia, in float32.

    The force points elsewhere, too, so no digit of the free solution is right.
    """
    rng = np.random.default_rng(5)
    J = rng.normal(size=(2000, 4, 7)) * 10.0 ** rng.uniform(0.0, 3.0, (2000, 4, 1))
    Mq = np.diag([0.8, 4.9, 4.3, 0.2, 0.07, 2.0, 0.013]).astype(np.float32)
    H = np.float32(J.swapaxes(1, 2) @ J) + 1e-5 * Mq
    assert np.any(np.linalg.eigvalsh(H.astype(float)) < 0.0)
    f = np.float32(rng.normal(size=(2000, 7)) * 1e5)
    tau = np.array([84.0, 117.0, 97.0, 26.0, 9.9, 32.0, 1.7], np.float32)
    fast = np.full(7, 100.0, np.float32)

    @jax.jit
    @jax.vmap
    def solve(H, f):
        hard = Rows.hard(jnp.asarray(Mq), -tau, tau)
        return solve_root(H, f, Rows.join([hard, Rows.soft(jnp.eye(7), -fast, fast)]))

    qdd, _ = jax.device_get(solve(H, f))
    assert np.all(np.isfinite(qdd))
