"""Kinematics and dynamics of an arm against engines that nobody here wrote."""

from __future__ import annotations

import importlib
import importlib.util
import tempfile
from pathlib import Path
from typing import NamedTuple

import jax
import mujoco
import numpy as np

from rmp_mjx.robot import Robot
from rmp_mjx.robot.configurations import random_configurations
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state, site_state

STATES = 100
"""Random states that are compared."""

ENOUGH = 1e-4
"""Greatest relative error of a good arm: the arm's text has six digits."""


class Terms(NamedTuple):
    """What is compared, at k states."""

    position: np.ndarray
    """Place of the end effector, (k, 3) [m]."""
    rotation: np.ndarray
    """Its orientation, (k, 3, 3)."""
    jacobian: np.ndarray
    """Its Jacobian in the world frame, linear part first, (k, 6, n)."""
    inertia: np.ndarray
    """Joint-space inertia, rotors included, (k, n, n) [kg m^2]."""
    bias: np.ndarray
    """Coriolis, gravity, dampers and springs, (k, n) [N m]."""


def certify(robot: Robot) -> dict[str, dict[str, float]]:
    """Greatest errors over random states, by engine and term.

    They are relative to the term's greatest entry. Computed in float64.
    """
    q = random_configurations(robot, STATES)
    qd = np.random.default_rng(1).normal(size=q.shape)
    ours = _ours(robot, q, qd)
    theirs = {"MuJoCo C": _mujoco(robot, q, qd)}
    if importlib.util.find_spec("pinocchio") is not None and not robot.assets:
        theirs["Pinocchio"] = _pinocchio(robot, q, qd, ours)
    return {
        engine: {
            name: float(np.max(np.abs(a - b)) / max(np.max(np.abs(b)), 1e-9))
            for name, a, b in zip(Terms._fields, ours, terms, strict=True)
        }
        for engine, terms in theirs.items()
    }


def _ours(robot: Robot, q: np.ndarray, qd: np.ndarray) -> Terms:
    @jax.jit
    @jax.vmap
    def at(q, qd):
        arm = arm_state(robot, q, qd)
        site = site_state(robot, arm)
        return site.p, site.R, site.J_pos, site.J_ori, *dynamics(robot, arm)

    with jax.enable_x64(True):
        p, R, J_pos, J_ori, Mq, bias = jax.device_get(at(q, qd))
    return Terms(p, R, np.concatenate([J_pos, J_ori], axis=1), Mq, bias)


def _mujoco(robot: Robot, q: np.ndarray, qd: np.ndarray) -> Terms:
    model = robot.mj_model
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data, n = mujoco.MjData(model), robot.n
    site = model.site(robot.site_name).id
    passive = robot.damping is not None or robot.stiffness is not None
    rows = []
    for data.qpos[:], data.qvel[:] in zip(q, qd, strict=True):
        mujoco.mj_forward(model, data)
        J, Mq = np.zeros((6, n)), np.zeros((n, n))
        mujoco.mj_jacSite(model, data, J[:3], J[3:], site)
        mujoco.mj_fullM(model, data, Mq)
        bias = data.qfrc_bias - data.qfrc_passive * passive
        R = data.site_xmat[site].reshape(3, 3).copy()
        rows.append((data.site_xpos[site].copy(), R, J, Mq, bias))
    return Terms(*(np.array(column) for column in zip(*rows, strict=True)))


def _pinocchio(robot: Robot, q: np.ndarray, qd: np.ndarray, ours: Terms) -> Terms:
    """Pinocchio reads the arm's own text; it knows no dampers and springs.

    It leaves out the pose of a fixed base: our first state says what that is.
    """
    pin = importlib.import_module("pinocchio")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.xml"
        path.write_text(robot.mjcf)
        model = pin.buildModelFromMJCF(str(path))
    data, frame = model.createData(), model.getFrameId(robot.site_name)
    pin.framesForwardKinematics(model, data, q[0])
    pose = data.oMf[frame]
    turn = ours.rotation[0] @ pose.rotation.T
    shift = ours.position[0] - turn @ pose.translation
    model.gravity.linear[:] = turn.T @ robot.gravity
    rows = []
    for q_k, qd_k in zip(q, qd, strict=True):
        pin.computeAllTerms(model, data, q_k, qd_k)
        pin.updateFramePlacements(model, data)
        J = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
        Mq = np.triu(data.M) + np.triu(data.M, 1).T
        pose = data.oMf[frame]
        bias = data.nle + _hold_passive(robot, q_k, qd_k)
        x, R = shift + turn @ pose.translation, turn @ pose.rotation
        rows.append((x, R, np.kron(np.eye(2), turn) @ J, Mq, bias))
    return Terms(*(np.array(column) for column in zip(*rows, strict=True)))


def _hold_passive(robot: Robot, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """What balances the dampers and springs that the controllers compensate."""
    held = np.zeros(robot.n)
    if robot.damping is not None:
        held += robot.damping * qd
    if robot.stiffness is not None:
        held += robot.stiffness * (q - robot.spring_ref)
    return held
