"""Root systems of the real controller with an obstacle at a chosen clearance."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import rmp_mjx as rmp
from rmp_mjx.math import critical_damping, orientation_error
from rmp_mjx.rmp import ScalarLeaf
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import (
    arm_state,
    base_point,
    forward_kinematics,
    site_state,
)

CLEARANCES = (0.1, 0.05, 0.02, 0.01, 0.005, 0.001)
"""Distances of the sphere's surface to the arm's [m]."""

RADIUS, TABLE = 0.05, -0.112
"""Radius of the sphere and height of the table plane [m]."""


class RootSystems(NamedTuple):
    """Least-squares form of the root, min |A qdd - b|, and the controller's answers."""

    A: np.ndarray
    """Rows sqrt(M_i) J_i of every leaf and the regulariser, (s, r, n) float64."""
    b: np.ndarray
    """Their right-hand sides, (s, r)."""
    qdd: np.ndarray
    """The controller's acceleration in float64, (s, n)."""
    states: tuple[np.ndarray, ...]
    """Their states: q, qd (s, n), action (s, 12), centre of the sphere (s, 3)."""


def control_points(robot: rmp.Robot, q: Array) -> Array:
    """World positions of the control points, (p, 3) [m]."""
    p, R = forward_kinematics(robot, q)
    segment = np.array(robot.points.segment)
    offset = jnp.asarray(robot.points.offset, p.dtype)
    moved = jnp.einsum("ijk,kj->ki", R[:, :, segment], offset)
    return base_point(robot) + p[:, segment].T + moved


def distances(robot: rmp.Robot, center: Array, q: Array) -> Array:
    """Distance of every control point to the sphere, then to the table, (2 p,) [m]."""
    x, rho = control_points(robot, q), jnp.asarray(robot.points.radius)
    sphere = jnp.linalg.norm(x - center, axis=1) - RADIUS - rho
    return jnp.concatenate([sphere, x[:, 2] - TABLE - rho])


def stack(ctrl: rmp.RMPVICES, q: Array, qd: Array, action: Array, center: Array):
    """All leaves as weighted rows, each its own Jacobian by autodiff.

    Returns:
        A (r, n) and b (r,) with A^T A the root's regularised metric and A^T b its f.
    """
    robot, n, leaves = ctrl.robot, ctrl.robot.n, ctrl.leaves
    if not isinstance(leaves.collision, ScalarLeaf):
        raise ValueError("the rows are those of one leaf for all obstacles")
    if leaves.joint_limit is None or leaves.posture is None:
        raise ValueError("the rows are those of a controller with all its branches")
    gap = functools.partial(distances, robot, center)
    d, rate, curvature = _second_jvp(gap, q, qd)
    f, m = leaves.collision.scalar(d, rate)
    root = jnp.sqrt(m)
    J = jax.jacfwd(gap)(q)
    collision = root[:, None] * J, jnp.where(m > 0, f / root, 0.0) - root * curvature

    f, m = leaves.joint_limit.scalar(q, qd)
    root = jnp.sqrt(m)
    limit = root[:, None] * jnp.eye(n), jnp.where(m > 0, f / root, 0.0)

    arm = arm_state(robot, q, qd)
    site = site_state(robot, arm)
    goal = ctrl.setpoint(q, ctrl.decode(action), 0.0)
    pull = goal.kp_pos * (goal.p_des - site.p) - critical_damping(goal.kp_pos) * site.v
    error = orientation_error(site.R, goal.R_des)
    turn = goal.kp_ori * error - critical_damping(goal.kp_ori) * site.w
    position = site.J_pos, pull - site.Jdot_qd_pos
    orientation = site.J_ori, turn - site.Jdot_qd_ori

    Mq, _ = dynamics(robot, arm)
    L = jnp.linalg.cholesky(Mq).T
    w = jnp.sqrt(leaves.posture.weight)
    posture = w * L, w * (L @ leaves.posture.acceleration(q, qd))
    regulariser = jnp.sqrt(ctrl.regularizer) * L, jnp.zeros(n)
    parts = (collision, limit, position, orientation, posture, regulariser)
    A, b = zip(*parts, strict=True)
    return jnp.concatenate(A), jnp.concatenate(b)


def _second_jvp(function: Any, q: Array, qd: Array) -> tuple[Array, Array, Array]:
    """Value, rate and acceleration at qdd = 0."""

    def first(q: Array) -> tuple[Array, Array]:
        return jax.jvp(function, (q,), (qd,))

    (value, rate), (_, curvature) = jax.jvp(first, (q,), (qd,))
    return value, rate, curvature


class RootSampler:
    """Draws root systems; compiled once for all clearances and leaf parameters."""

    def __init__(self, ctrl: rmp.RMPVICES):
        """Compile lazily.

        Args:
            ctrl: A controller without self-collision leaf; its collision leaf is
                replaced at each call.
        """
        if ctrl.leaves.self_collision is not None:
            raise ValueError("root systems are drawn without a self-collision leaf")
        self.ctrl = ctrl
        robot = ctrl.robot
        points = functools.partial(control_points, robot)
        self._motion = jax.jit(jax.vmap(lambda q, qd: jax.jvp(points, (q,), (qd,))))
        self._gaps = jax.jit(jax.vmap(functools.partial(distances, robot)))
        self._rows = jax.jit(self._all_rows)
        self._qdd = jax.jit(self._all_accelerations)

    def _all_rows(self, leaf: ScalarLeaf, *states: Array) -> tuple[Array, Array]:
        ctrl = self.ctrl.with_collision(leaf)
        return jax.vmap(functools.partial(stack, ctrl))(*states)

    def _all_accelerations(self, leaf: ScalarLeaf, *states: Array) -> Array:
        ctrl = self.ctrl.with_collision(leaf)

        def one(q: Array, qd: Array, action: Array, center: Array) -> Array:
            table = np.array([[0.0, 0.0, TABLE]]), np.array([[0.0, 0.0, 1.0]])
            slots = rmp.Obstacles.empty(spheres=1, planes=1).with_planes(*table)
            slots = slots.with_spheres(center[None], np.full(1, RADIUS))
            setpoint = ctrl.setpoint(q, ctrl.decode(action), 0.0)
            return ctrl(q, qd, setpoint, slots).qdd

        return jax.vmap(one)(*states)

    def draw(
        self, leaf: ScalarLeaf, clearance: float, count: int, seed: int
    ) -> RootSystems:
        """Random states about the home pose, a moving point heading for a sphere.

        The sphere is `clearance` away from a random point of the outer links, in the
        direction in which the point moves; no other point is nearer to anything.
        """
        robot, n = self.ctrl.robot, self.ctrl.robot.n
        rng = np.random.default_rng(seed)
        tries = 48 * count
        q = np.asarray(robot.q_home) + 0.4 * rng.standard_normal((tries, n))
        qd = 0.5 * rng.standard_normal((tries, n))
        action = rng.uniform(-1, 1, (tries, rmp.ACTION_SIZE))
        outer = np.flatnonzero(np.array(robot.points.segment) >= 3)
        point = rng.choice(outer, tries)
        with jax.enable_x64(True):
            x, v = (np.asarray(y)[np.arange(tries), point] for y in self._motion(q, qd))
            away = RADIUS + np.asarray(robot.points.radius)[point] + clearance
            heading = v / np.linalg.norm(v, axis=1, keepdims=True)
            center = x + heading * away[:, None]
            gaps = np.asarray(self._gaps(center, q))
            inside = (q > robot.q_lower + 0.1) & (q < robot.q_upper - 0.1)
            good = (np.min(gaps, axis=1) > clearance - 1e-9) & inside.all(axis=1)
            keep = np.flatnonzero(good)[:count]
            if len(keep) < count:
                raise RuntimeError(f"{len(keep)} of {count} states fit {clearance} m")
            states = tuple(z[keep] for z in (q, qd, action, center))
            A, b = (np.asarray(y) for y in self._rows(leaf, *states))
            qdd = np.asarray(self._qdd(leaf, *states))
        return RootSystems(A, b, qdd, states)

    def float32(self, leaf: ScalarLeaf, systems: RootSystems) -> np.ndarray:
        """The controller's accelerations with everything in float32, (s, n).

        Call `jax.clear_caches` between `draw` and this. Otherwise JAX would reuse what
        it traced in the other precision.
        """
        single = (jnp.asarray(z, jnp.float32) for z in systems.states)
        return np.asarray(self._qdd(leaf, *single))
