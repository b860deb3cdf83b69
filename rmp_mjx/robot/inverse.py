"""Inverse kinematics of many poses at once, by damped least squares (NumPy).

`robot` is a `Robot` everywhere.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from rmp_mjx.robot.configurations import joint_frames

DAMPING = 1e-6, 1e-2
"""Added to the squares of the singular values: this, and this times the error's square
(Sugihara, 2011)."""

STEP = 0.3
"""Greatest change of position [m], rotation [rad] and joints [rad or m] at a time."""


def hand_pose(
    robot: Any, q: Float[np.ndarray, "s n"]
) -> tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3 3"]]:
    """World position [m] and orientation of the end effector in s configurations."""
    p, R = joint_frames(robot, q)
    return p[-1] + R[-1] @ robot.site_offset, R[-1] @ robot.site_rotation


def reach(
    robot: Any,
    q: Float[np.ndarray, "s n"],
    position: Float[np.ndarray, "s 3"],
    rotation: Float[np.ndarray, "s 3 3"],
    steps: int = 50,
    rest: Float[np.ndarray, "s n"] | None = None,
) -> tuple[Float[np.ndarray, "s n"], Float[np.ndarray, " s"]]:
    """Lead the end effector to s poses, within the joint limits.

    Args:
        robot: The arm.
        q: Where to begin, (s, n) [rad or m].
        position: Wanted positions, (s, 3) [m].
        rotation: Wanted orientations, (s, 3, 3).
        steps: How often to improve.
        rest: What a redundant arm prefers, (s, n); default the beginning.

    Returns:
        Joint coordinates, and what is left: the distance in metres plus the angle in
        radians, (s,).
    """
    rest = q if rest is None else rest
    for _ in range(steps):
        error, J = _error(robot, q, position, rotation)
        damping = DAMPING[0] + DAMPING[1] * np.square(error).sum(axis=1)
        back = np.swapaxes(J, 1, 2)
        J_back = back @ np.linalg.inv(J @ back + damping[:, None, None] * np.eye(6))
        free = np.eye(robot.n) - J_back @ J
        move = np.einsum("snk,sk->sn", J_back, error)
        move += np.einsum("snm,sm->sn", free, 0.2 * (rest - q))
        move *= np.minimum(1.0, STEP / np.maximum(np.abs(move).max(1), 1e-9))[:, None]
        q = np.clip(q + move, robot.q_lower, robot.q_upper)
    left = _error(robot, q, position, rotation)[0]
    return q, np.linalg.norm(left[:, :3], axis=1) + np.linalg.norm(left[:, 3:], axis=1)


def _error(
    robot: Any, q: np.ndarray, position: np.ndarray, rotation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What is left, (s, 6), at most `STEP` each, and the Jacobian, (s, 6, n)."""
    p, R = joint_frames(robot, q)
    hand, turned = p[-1] + R[-1] @ robot.site_offset, R[-1] @ robot.site_rotation
    z, hinge = R[..., 2], np.array(robot.hinge)[:, None, None]
    linear = np.where(hinge, np.cross(z, hand - p), z)
    J = np.concatenate([linear, np.where(hinge, z, 0.0)], axis=-1)
    turn = rotation @ np.swapaxes(turned, 1, 2)
    axis = 0.5 * np.stack([turn[:, k - 1, k - 2] for k in range(3)], axis=1)
    axis -= 0.5 * np.stack([turn[:, k - 2, k - 1] for k in range(3)], axis=1)
    # The vector part of a turn falls again beyond 90 degrees.
    sine = np.linalg.norm(axis, axis=1)
    cosine = 0.5 * (np.trace(turn, axis1=1, axis2=2) - 1.0)
    angle = np.arctan2(sine, cosine)
    axis *= (angle / np.maximum(sine, 1e-12))[:, None]
    parts = [_at_most(position - hand), _at_most(axis)]
    return np.concatenate(parts, axis=1), np.moveaxis(J, 0, -1)


def _at_most(x: np.ndarray) -> np.ndarray:
    """Vectors (s, 3), none longer than `STEP`."""
    length = np.linalg.norm(x, axis=1, keepdims=True)
    return x * np.minimum(1.0, STEP / np.maximum(length, 1e-9))
