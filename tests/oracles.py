"""What MuJoCo C, Pinocchio and Clarabel say: quantities the library must match.

And an arm that is nowhere symmetric, to measure.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
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


BENT = """<mujoco><worldbody><body name="base" pos=".3 -.2 .5" euler="20 -30 40">
<geom name="base" type="capsule" fromto="0 0 -.1 .05 0 .1" size=".06"/>
<body name="one" pos="0 .05 .1" euler="0 10 0">
 <joint name="a" axis="0 0 1" ref="20"/>
 <geom name="one" type="capsule" fromto="0 0 0 0 .1 .2" size=".05"/>
 <body name="two" pos="0 .1 .2" euler="0 0 30">
  <joint name="b" type="slide" axis="1 2 2" ref=".1" range="-.1 .2"/>
  <geom name="two" type="capsule" fromto="0 0 0 .2 0 .1" size=".04"/>
  <body name="three" pos=".2 0 .1" euler="10 0 0">
   <joint name="c" pos=".01 0 .02" axis="0 1 .3" range="-150 150"/>
   <geom name="three" type="capsule" fromto="0 0 0 .25 0 0" size=".03"/>
   <body name="four" pos=".25 0 0">
    <joint name="d" axis="0 1 0" ref="-30" range="-160 120"/>
    <geom name="four" type="capsule" fromto="0 0 0 .2 0 .05" size=".025"/>
    <geom name="ball" size=".03" pos=".22 .01 .05"/>
    <site name="tip" pos=".2 .03 .08" euler="15 25 35"/>
</body></body></body></body></body></worldbody><actuator>
<motor joint="a" ctrlrange="-90 90"/><motor joint="b" ctrlrange="-80 80"/>
<motor joint="c" ctrlrange="-30 30"/><motor joint="d" ctrlrange="-9 9"/>
</actuator></mujoco>"""
"""A turned base away from the origin, a slide, offset axes, non-zero references, a
joint without limits; every geom is a capsule or a ball, one of them on the base."""


class Measured:
    """What MuJoCo C says of an arm in one configuration after another."""

    def __init__(self, robot):
        self.robot, self.model = robot, robot.mj_model
        self.data = mujoco.MjData(self.model)

    def at(self, q) -> mujoco.MjData:
        """MuJoCo's data at joint coordinates q, (n,)."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        return self.data

    def gaps(self, q, pairs) -> np.ndarray:
        """Distances of pairs of the robot's capsules, (k,) [m]."""
        data, names = self.at(q), self.robot.capsules.geom
        ids = [[self.model.geom(names[c]).id for c in pair] for pair in pairs]
        return np.array(
            [mujoco.mj_geomDistance(self.model, data, *x, 9.0, None) for x in ids]
        )

    def points(self, q) -> np.ndarray:
        """World positions of the control points, (p, 3) [m]."""
        data, found = self.at(q), []
        for body, offset, _ in self.robot.control_points:
            b = self.model.body(body).id
            found.append(data.xpos[b] + data.xmat[b].reshape(3, 3) @ offset)
        return np.array(found)


def along(distances, q, qd, step=1e-4):
    """Rate and acceleration of `distances(q, t)` on the line q + t qd, and its gradient
    by the joints, (k,), (k,), (k, n), by central differences."""
    before, now, after = (distances(q + t * qd, t) for t in (-step, 0.0, step))
    rate, acceleration = (after - before) / 2 / step, (after - 2 * now + before) / step
    columns = [
        (distances(q + e, 0.0) - distances(q - e, 0.0)) / 2 / step
        for e in step * np.eye(len(q))
    ]
    return rate, acceleration / step, np.stack(columns, axis=1)


def in_float64(function):
    """The function compiled and called in float64, with what it returns as NumPy."""
    compiled = jax.jit(function)

    def run(*args):
        with jax.enable_x64(True):
            return jax.device_get(compiled(*args))

    return run
