"""Bounds of an arm that hold in every configuration: lever arms and torques."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rmp_mjx.pytree import Constant, Pytree
from rmp_mjx.robot.model import Robot


class Bounds(Pytree):
    """Constants of an arm that hold in every configuration; n joints, p points."""

    lever: Float[Constant, "n n"]
    """Largest distance of link l, surface included, from the axis of joint j [m]:
    a joint moves no point of the link faster than lever times its velocity."""
    bend: Float[Constant, "n*n n"]
    """Curvature of the paths of link l's points on a line in the joints, for the
    products of two joints' speeds [m/s^2 per rad^2/s^2]."""
    pair_lever: Float[Constant, "k n"]
    """As `lever`, for pairs of link capsules: the joints between the two only."""
    pair_bend: Float[Constant, "n*n k"]
    """As `bend`, for those pairs."""
    coriolis: Float[Constant, "n*n n"]
    """Coriolis torque for the products of two joints' speeds [N m s^2/rad^2]."""
    inertia: Float[Constant, "n*n n"]
    """Rate of change of Mq v along v, likewise [N m s^2/rad^2]."""
    load: Float[Constant, "n n"]
    """Rate of change of the holding torque i with joint j [N m/rad]."""
    scallop: Float[Constant, " p"]
    """How far a link sticks out between its control points [m]."""

    @staticmethod
    def of(robot: Robot) -> Bounds:
        """Closed-form bounds from the lengths, masses and inertias of the chain.

        Raises:
            ValueError: A sliding joint has no limits, so that no lever is bounded.
        """
        n = robot.n
        slides = ~np.array(robot.hinge)
        travel = np.maximum(
            np.abs(robot.q_lower - robot.q_ref), np.abs(robot.q_upper - robot.q_ref)
        )
        travel = np.where(slides, travel, 0.0)
        if not np.isfinite(travel).all():
            raise ValueError("bounds need limits on every sliding joint")

        def row(link: int, x: np.ndarray, radius: float) -> np.ndarray:
            """Levers of a point of a link: triangle inequalities along the chain."""
            levers, tail = np.zeros(n), np.linalg.norm(x) + radius
            levers[link] = np.hypot(x[0], x[1]) + radius
            for j in reversed(range(link)):
                tail += travel[j + 1]
                levers[j] = np.hypot(*robot.offset[j + 1][:2]) + tail
                tail += np.linalg.norm(robot.offset[j + 1])
            return np.where(slides & (np.arange(n) <= link), 1.0, levers)

        lever = np.zeros((n, n))
        points, capsules = robot.points, robot.capsules
        everything = [
            *zip(points.segment, points.offset, points.radius, strict=True),
            *zip(capsules.segment, capsules.start, capsules.radius, strict=True),
            *zip(capsules.segment, capsules.end, capsules.radius, strict=True),
        ]
        for k, x, radius in everything:
            if k >= 0:
                lever[k] = np.maximum(lever[k], row(k, x, float(radius)))
        pair_lever, joints = np.zeros((len(capsules.pairs), n)), np.arange(n)
        for i, (far, near) in enumerate(capsules.pairs):
            a, b = capsules.segment[far], capsules.segment[near]
            pair_lever[i] = np.where((joints > b) & (joints <= a), lever[a], 0.0)

        centre = np.stack([row(k, robot.com[k], 0.0) for k in range(n)])
        spin = np.linalg.eigvalsh(robot.inertia)[:, -1]
        later = np.maximum.outer(joints, joints)
        coriolis, inertia, load = (np.zeros((n, n, n)) for _ in range(3))
        for k in range(n):
            inner, moved = joints <= k, later <= k
            bend = np.where(moved, centre[k][later], 0.0)
            turn = np.where(moved, spin[k], 0.0)
            swing = np.where(moved, centre[k][later], 0.0)
            for i in range(k + 1):
                wrench = robot.mass[k] * centre[k, i] * bend
                drag = robot.mass[k] * np.outer(swing[i], centre[k] * inner)
                coriolis[i] += wrench + 1.5 * turn
                inertia[i] += wrench + 0.5 * (drag + drag.T) + 3.5 * turn
            load[k] = robot.mass[k] * bend
        weight = np.linalg.norm(robot.gravity) * load.sum(axis=0)
        if robot.stiffness is not None:
            weight = weight + np.diag(robot.stiffness)
        return Bounds(
            lever=lever,
            bend=_bend(lever),
            pair_lever=pair_lever,
            pair_bend=_bend(pair_lever),
            coriolis=coriolis.reshape(n, -1).T,
            inertia=inertia.reshape(n, -1).T,
            load=weight,
            scallop=_scallop(robot),
        )


def _bend(lever: np.ndarray) -> np.ndarray:
    """Bound of |d2x / dqi dqj|, the outer joint's lever: (n*n, k)."""
    n = lever.shape[1]
    later = np.maximum.outer(np.arange(n), np.arange(n))
    moved = (lever > 0)[:, :, None] & (lever > 0)[:, None, :]
    return np.where(moved, lever[:, later], 0.0).reshape(-1, n * n).T


def _scallop(robot: Robot) -> np.ndarray:
    """What the spheres of the control points leave out of their capsules, (p,) [m]."""
    points = robot.points
    x, radius = np.asarray(points.offset), np.asarray(points.radius)
    same = np.array(points.segment)[:, None] == np.array(points.segment)
    same &= (radius[:, None] == radius) & ~np.eye(len(x), dtype=bool)
    apart = np.linalg.norm(x[:, None] - x, axis=-1)
    gap = np.min(np.where(same, apart, np.inf), axis=1, initial=np.inf)
    half = np.minimum(np.where(np.isfinite(gap), gap, 0.0) / 2, radius)
    return radius - np.sqrt(radius**2 - half**2)


def squares_of(u: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """The joints' speeds |u|, and the products of every two of them, (n*n,)."""
    size = jnp.abs(u)
    return size, (size[:, None] * size[None, :]).reshape(-1)
