"""VICES, and RMP-VICES without its safety leaves, against NumPy on MuJoCo's terms.

Float64; MuJoCo C supplies Jacobians, inertia and bias, NumPy the control laws.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rmp_mjx import RMPVICES, Leaves
from rmp_mjx.control.vices import OSC
from tests import oracles


@pytest.fixture(scope="module")
def case(robot, states, obstacles):
    """States, the terms MuJoCo gives there, and the impedance accelerations."""
    q, qd, action = states(3)
    terms = oracles.mujoco_terms(robot.mj_model, robot.site_name, q, qd)
    R_des = np.einsum(
        "kij,kjl->kil", Rotation.from_rotvec(0.2 * action[:, 3:6]).as_matrix(), terms.R
    )
    error = 0.5 * np.cross(terms.R, R_des, axis=1).sum(axis=2)
    kp = 10.0 * 30.0 ** (0.5 * (action[:, 6:] + 1.0))
    velocity = np.einsum("kij,kj->ki", terms.J, qd)
    spring = kp * np.hstack([0.05 * action[:, :3], error])
    wanted = spring - 2.0 * np.sqrt(kp) * velocity
    return (q, qd, action, obstacles(3)), terms, wanted


def _inverse_operational_inertia(J, Mq):
    return J @ np.linalg.solve(Mq, J.T)


def test_vices_is_the_papers_equation_2(run64, robot, vices, case):
    """J_p^T L_p a_p + J_o^T L_o a_o + N^T Mq qdd_0 + b, clipped joint by joint.

    1e-7 of each torque limit: near singular poses the operational inertia amplifies
    rounding by its condition, up to 1e6.
    """
    (q, qd, *_), terms, wanted = case
    out = run64(vices, *case[0])
    for k in range(len(q)):
        J, Mq = terms.J[k], terms.Mq[k]
        tau = terms.bias[k].copy()
        for block in (slice(0, 3), slice(3, 6)):
            inverse = _inverse_operational_inertia(J[block], Mq)
            tau += J[block].T @ np.linalg.solve(inverse, wanted[k, block])
        qdd_0 = 10.0 * (robot.q_home - q[k]) - 2.0 * np.sqrt(10.0) * qd[k]
        inverse = _inverse_operational_inertia(J, Mq)
        tau += Mq @ qdd_0 - J.T @ np.linalg.solve(inverse, J @ qdd_0)
        expected = np.clip(tau, -robot.tau_max, robot.tau_max)
        assert np.max(np.abs(out.tau[k] - expected) / robot.tau_max) < 1e-7
        assert np.array_equal(
            out.diagnostics["torque_limit"][k], np.sign(tau) * (tau != expected)
        )


def test_vices_ignores_obstacles(run64, vices, case, obstacles):
    q, qd, action, near = case[0]
    same = run64(vices, q, qd, action, obstacles(7)).tau
    np.testing.assert_array_equal(same, run64(vices, q, qd, action, near).tau)


def test_tree_without_safety_converges_to_coupled_operational_space_control(
    run64, robot, case
):
    """tau -> J^T Lambda (a - Jdot qd) + b with the full 6x6 Lambda as eps -> 0.

    The relative error falls in proportion to eps: its median is 6 eps (until rounding
    stops it at 2e-7, from eps = 1e-8 on). The 5 % of the 500 states nearest to a
    singularity, where the limit itself diverges, are left out.
    """
    args, terms, wanted = case
    strong = robot.replace(tau_max=np.full(7, 1e12))
    off = dict.fromkeys(("obstacle_relaxation", "limit_relaxation"))
    expected, quality = [], []
    for k in range(len(args[0])):
        J, Mq = terms.J[k], terms.Mq[k]
        inverse = _inverse_operational_inertia(J, Mq)
        wrench = np.linalg.solve(inverse, wanted[k] - terms.Jdot_qd[k])
        expected.append(J.T @ wrench)
        quality.append(1.0 / np.linalg.cond(inverse))
    expected = np.array(expected)
    regular = np.array(quality) > np.quantile(quality, 0.05)

    medians = []
    for eps in (1e-3, 1e-5, 1e-7):
        out = run64(RMPVICES(strong, Leaves(), regularizer=eps, **off), *args)
        error = np.abs(out.tau - terms.bias - expected).max(1)
        relative = (error / np.abs(expected).max(1))[regular]
        medians.append(np.median(relative))
    np.testing.assert_allclose(np.diff(np.log10(medians)), -2.0, atol=0.05)
    assert medians[-1] < 1e-6 and relative.max() < 1e-4


def test_it_is_vices_at_its_own_stiffness(run64, robot, vices, states, obstacles):
    """1e-9 of the torque limits: the stiffness goes through a logarithm and back."""
    q, qd, action = states(5)
    osc = OSC(robot)
    span = osc.action_range
    same = 2.0 * np.log(osc.kp / span.kp_min) / np.log(span.kp_max / span.kp_min) - 1.0
    fixed = np.concatenate([action[:, :6], np.full((len(q), 6), same)], axis=1)
    near = obstacles(5)
    ours, theirs = run64(osc, q, qd, action, near), run64(vices, q, qd, fixed, near)
    error = np.abs(ours.tau - theirs.tau) / robot.tau_max
    assert error.max() < 1e-9
    assert np.abs(ours.tau - run64(vices, q, qd, action, near).tau).max() > 1.0
