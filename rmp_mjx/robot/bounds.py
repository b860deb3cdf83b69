"""Bounds of an arm that hold in every configuration: lever arms and torques."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rmp_mjx.pytree import Constant, Pytree
from rmp_mjx.robot.kinematics import ArmState, Motion, carry_points
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
    centre: Float[Constant, "n n"]
    """As `lever`, for the links' centres of mass [m]."""
    spin: Float[Constant, " n"]
    """Greatest principal inertia of each link [kg m^2]."""
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
        return Bounds(
            lever=lever,
            bend=_bend(lever),
            pair_lever=pair_lever,
            pair_bend=_bend(pair_lever),
            centre=centre,
            spin=np.linalg.eigvalsh(robot.inertia)[:, -1],
            scallop=_scallop(robot),
        )

    def levers(
        self, now: Float[Array, "n n"], u: Float[Array, " n"], way: Array | float
    ) -> Float[Array, "n n"]:
        """Levers of the centres of mass everywhere on a line in the joints.

        Args:
            now: Levers where it begins, see `centre_levers`, (n, n) [m].
            u: Its direction, (n,) [rad/s].
            way: Its length [s].
        """
        moving = jnp.asarray(self.centre, u.dtype) * jnp.abs(u)[None]
        between = jnp.asarray(np.tril(np.ones((len(u), len(u))), -1), u.dtype)
        gain = jnp.matmul(moving, between, precision="highest")
        return jnp.minimum(jnp.asarray(self.centre, u.dtype), now + way * gain)

    def torques(
        self, robot: Robot, R: Float[Array, "n n"], u: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
        """Bounds of torques on a line in the joints, from the levers R on it.

        Returns:
            The Coriolis torque at velocity u [N m]; the rate at which Mq u changes on
            the line [N m]; that of the torque that holds the arm [N m/s].
        """
        dtype, size = u.dtype, jnp.abs(u)
        mass = jnp.asarray(robot.mass, dtype)
        inner = jnp.cumsum(size)

        def pulled(x: Array) -> Array:
            return jnp.matmul(x, R, precision="highest")

        def swung(x: Array) -> Array:
            """As `pulled`, for the joint columns' rates of change."""
            each = pulled(x)
            outer = jnp.cumsum((size * each)[::-1])[::-1] - size * each
            return inner * each + outer

        bend = mass * jnp.sum(R * (size * (2.0 * inner - size))[None], axis=1)
        speed = mass * jnp.sum(R * size[None], axis=1)
        turn = jnp.cumsum((jnp.asarray(self.spin, dtype) * inner**2)[::-1])[::-1]
        load = jnp.sqrt(jnp.sum(jnp.asarray(robot.gravity, dtype) ** 2)) * swung(mass)
        if robot.stiffness is not None:
            load = load + jnp.asarray(robot.stiffness, dtype) * size
        coriolis = pulled(bend)
        return coriolis + 1.5 * turn, coriolis + swung(speed) + 3.5 * turn, load


def centre_levers(robot: Robot, arm: ArmState) -> Float[Array, "n n"]:
    """Distances of the links' centres of mass from the joint axes, (n, n) [m].

    Row k is link k's; entries of joints that do not move it are 0.
    """
    c, _ = carry_points(robot, arm, robot.com, np.arange(robot.n))
    S = Motion(*(part.map(lambda s: s[None]) for part in (arm.S.lin, arm.S.ang)))
    moved = S.at(c.map(lambda x: x[:, None]))
    inner = np.tril(np.ones((robot.n, robot.n), bool))
    return jnp.where(inner, jnp.sqrt(jnp.where(inner, moved @ moved, 1.0)), 0.0)


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
