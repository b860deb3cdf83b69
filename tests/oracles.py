"""What MuJoCo C, Pinocchio and Clarabel say: quantities the library must match."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from scipy import sparse


class Terms(NamedTuple):
    """Pose, Jacobian and curvature of the site, inertia and bias, at k states."""

    p: np.ndarray
    """Site position, (k, 3) [m]."""
    R: np.ndarray
    """Site orientation, (k, 3, 3)."""
    J: np.ndarray
    """Jacobian in the world frame, linear part first, (k, 6, n)."""
    Jdot_qd: np.ndarray
    """Curvature, linear part first, (k, 6)."""
    Mq: np.ndarray
    """Inertia, (k, n, n)."""
    bias: np.ndarray
    """Coriolis, centrifugal and gravity forces, (k, n)."""


def mujoco_terms(model: mujoco.MjModel, site: str, q, qd) -> Terms:
    """Every term from MuJoCo C."""
    data, n = mujoco.MjData(model), model.nv
    i = model.site(site).id
    rows = []
    for q_k, qd_k in zip(q, qd, strict=True):
        data.qpos[:], data.qvel[:] = q_k, qd_k
        mujoco.mj_forward(model, data)
        J, Jdot, Mq = np.zeros((6, n)), np.zeros((6, n)), np.zeros((n, n))
        mujoco.mj_jacSite(model, data, J[:3], J[3:], i)
        point = data.site_xpos[i].copy()
        mujoco.mj_jacDot(model, data, Jdot[:3], Jdot[3:], point, model.site_bodyid[i])
        mujoco.mj_fullM(model, data, Mq)
        R = data.site_xmat[i].reshape(3, 3).copy()
        rows.append((point, R, J, Jdot @ qd_k, Mq, data.qfrc_bias.copy()))
    return Terms(*(np.array(column) for column in zip(*rows, strict=True)))


def pinocchio_terms(pin, path: str, site: str, q, qd) -> Terms:
    """Every term from Pinocchio, which reads the same MJCF file."""
    model = pin.buildModelFromMJCF(path)
    data, frame = model.createData(), model.getFrameId(site)
    world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    rows = []
    for q_k, qd_k in zip(q, qd, strict=True):
        pin.computeAllTerms(model, data, q_k, qd_k)
        Mq = np.triu(data.M) + np.triu(data.M, 1).T
        bias = data.nle.copy()
        pin.forwardKinematics(model, data, q_k, qd_k, np.zeros(model.nv))
        pin.updateFramePlacements(model, data)
        J = pin.getFrameJacobian(model, data, frame, world)
        Jdot_qd = pin.getFrameClassicalAcceleration(model, data, frame, world).vector
        pose = data.oMf[frame]
        rows.append(
            (pose.translation.copy(), pose.rotation.copy(), J, Jdot_qd, Mq, bias)
        )
    return Terms(*(np.array(column) for column in zip(*rows, strict=True)))


def without_limits_or_passive_forces(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model as pure rigid-body dynamics: tau = Mq qdd + bias, nothing else."""
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.dof_damping[:] = 0.0
    model.jnt_stiffness[:] = 0.0
    return model


def soft_program(clarabel, P, q, G, h, length, penalty) -> np.ndarray:
    """Clarabel's x of min x'Px/2 + q'x + penalty t't/2 with Gx - length t <= h."""
    m = len(h)
    cost = sparse.block_diag([P, penalty * sparse.eye(m)])
    A = sparse.hstack([sparse.csc_matrix(G), -sparse.diags(length)])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    solver = clarabel.DefaultSolver(
        sparse.triu(cost).tocsc(),
        np.concatenate([q, np.zeros(m)]),
        A.tocsc(),
        h,
        [clarabel.NonnegativeConeT(m)],
        settings,
    )
    return np.array(solver.solve().x[: len(q)])
