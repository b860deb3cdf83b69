"""What a session compiles: a step of any controller, and what the tree thinks."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rmp_mjx.control.avoidance import obstacle_gaps
from rmp_mjx.math import exp_so3, log_so3, quat_to_mat
from rmp_mjx.robot import Robot
from rmp_mjx.robot.kinematics import arm_state, site_pose
from rmp_mjx.robot.point_state import point_state
from rmp_mjx.types import Setpoint
from rmp_mjx.viewer.dials import named, turned
from rmp_mjx.viewer.insight import Insight, think

LEAD = (0.05, 0.2)
"""The set-point is at most so far ahead of the hand [m, rad], as a policy's is."""


def lead(robot: Robot, q: Any, p: Any, wxyz: Any, gains: Any, at: Any) -> Setpoint:
    """The set-point on the way to a target, at most `LEAD` ahead of the hand."""
    here, R = site_pose(robot, q)
    R_target = quat_to_mat(wxyz)
    turn = log_so3(jnp.matmul(R_target, R.T, precision="highest"))
    ahead, turn = (
        x * jnp.minimum(1.0, most / jnp.maximum(jnp.linalg.norm(x), 1e-9))
        for x, most in zip((p - here, turn), LEAD, strict=True)
    )
    kp_pos, kp_ori = (jnp.full(3, kp) for kp in gains)
    R_des = jnp.matmul(exp_so3(turn), R, precision="highest")
    return Setpoint(here + ahead, R_des, kp_pos, kp_ori, at)


def control(
    base: dict[str, Any],
    index: Any,
    values: dict[str, Any],
    q,
    qd,
    p,
    wxyz,
    gains,
    at,
    around,
    tau_ext,
    tau_last,
) -> tuple[Any, Any, Any]:
    """Torque, acceleration and clearance of any of the controllers, by its index."""
    robot = next(iter(base.values())).robot
    setpoint = lead(robot, q, p, wxyz, gains, at)

    def branch(name: str):
        def run():
            out = turned(base[name], named(base[name], values[name]))(
                q, qd, setpoint, around, tau_ext, tau_last
            )
            return out.tau, out.qdd

        return run

    tau, qdd = jax.lax.switch(index, [branch(name) for name in base])
    points = point_state(robot, arm_state(robot, q, qd))
    nearest = [
        jnp.min(jnp.where(gap.active, gap.distance, jnp.inf))
        for gap in obstacle_gaps(robot, points, around).values()
    ]
    return tau, qdd, jnp.min(jnp.stack(nearest))


def thought(base, values, q, qd, qdd, p, wxyz, gains, at, around, tau_ext) -> Insight:
    """What a tree thinks, its dials turned."""
    setpoint = lead(base.robot, q, p, wxyz, gains, at)
    return think(
        turned(base, named(base, values)), q, qd, qdd, setpoint, around, tau_ext
    )
