"""One control problem as plain arrays, for contestants that cannot import ours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rmp_mjx as rmp
from benchmarks.speed.bench_controller import BATCH, random_states
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state

BARRIER = ("mu", "eps", "eta", "r", "margin", "x_min", "cap", "k_out", "v_out")


def controller(robot: rmp.Robot) -> rmp.RMPVICES:
    """Our controller without the parts that RMP2 lacks."""
    leaves = rmp.Leaves.default(robot).replace(self_collision=None)
    return rmp.RMPVICES(robot, leaves, obstacle_relaxation=None, limit_relaxation=None)


def arrays(seed: int) -> dict[str, Any]:
    """The arm, its control points, the leaves, a batch of states, our result.

    Float64, SI units; states have a leading batch axis. ``regularizer`` is the inertia
    matrix, metric of posture and regulariser; ``posture`` is (stiffness, damping,
    weight, weight of the regulariser); ``qdd`` the accelerations of `controller`.
    """
    robot = rmp.Robot.load("jaco2")
    ctrl: Any = controller(robot)
    q, qd, action, obstacles = jax.tree.map(double, random_states(robot, BATCH, seed))
    setpoint = jax.jit(jax.vmap(ctrl.setpoint, in_axes=(0, 0, None)))(q, action, 0.0)

    @jax.jit
    @jax.vmap
    def evaluate(q, qd, setpoint):
        Mq, _ = dynamics(robot, arm_state(robot, q, qd))
        return Mq, ctrl(q, qd, setpoint, obstacles).qdd

    Mq, qdd = evaluate(q, qd, setpoint)
    leaves = {
        "collision": ctrl.leaves.collision,
        "joint_limit": ctrl.leaves.joint_limit.barrier,
    }
    barriers = {
        name: [getattr(leaf, field) for field in BARRIER]
        for name, leaf in leaves.items()
    }
    posture, points = ctrl.leaves.posture, robot.points
    found = barriers | {
        "offset": robot.offset,
        "rotation": robot.rotation,
        "q_ref": robot.q_ref,
        "q_home": robot.q_home,
        "q_lower": robot.q_lower,
        "q_upper": robot.q_upper,
        "site_offset": robot.site_offset,
        "site_rotation": robot.site_rotation,
        "point_offset": points.offset,
        "point_radius": points.radius,
        "center": obstacles.spheres.center,
        "radius": obstacles.spheres.radius,
        "posture": [posture.kq, posture.kd, posture.weight, ctrl.regularizer],
        "regularizer": Mq,
        "qdd": qdd,
        "q": q,
        "qd": qd,
        "p_des": setpoint.p_des,
        "R_des": setpoint.R_des,
        "kp_pos": setpoint.kp_pos,
        "kp_ori": setpoint.kp_ori,
    }
    found = {name: np.asarray(value, float) for name, value in found.items()}
    segment = np.array(points.segment)
    if (np.diff(segment) < 0).any() or segment[0] < 0:
        raise ValueError("the control points must be in the order of their links")
    return found | {"point_segment": segment}


def write(path: Path, seed: int) -> None:
    """Write `arrays` to a file."""
    with jax.enable_x64(True):
        np.savez(path, **arrays(seed))


def double(x) -> jax.Array:
    """Convert an array of floating-point numbers to float64."""
    x = np.asarray(x)
    return jnp.asarray(x, jnp.float64 if x.dtype.kind == "f" else x.dtype)
