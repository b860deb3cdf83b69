"""The rival's input: the scene, the arm's constants, and states to compare."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import envs
import rmp_mjx as rmp
from benchmarks.peers.problem import BARRIER, double
from benchmarks.speed.bench_controller import BATCH, random_states
from envs.scene import ARM, TABLE_HEIGHT

SCENE, ARRAYS = "scene.mjb", "arrays.npz"


def arm_arrays(env: envs.ArmEnv) -> dict[str, Any]:
    """The constants of the rival's `Arm`."""
    robot, model = env.robot, env.scene.model
    ctrl: Any = env.controller
    points, capsules = robot.points, robot.capsules
    geoms = [model.geom(ARM + name).id for name in capsules.geom]
    leaves = ctrl.leaves
    posture = leaves.posture
    return {
        "point_body": np.array([model.body(ARM + name).id for name in points.body]),
        "point_joint": np.array(points.segment),
        "point_offset": np.asarray(points.body_offset),
        "point_radius": np.asarray(points.radius),
        "capsule_geom": np.array(geoms),
        "capsule_joint": np.array(capsules.segment),
        "capsule_size": model.geom_size[geoms, :2].copy(),
        "pairs": np.array(capsules.pairs),
        "site": np.array(model.site(ARM + robot.site_name).id),
        "q_home": np.asarray(robot.q_home),
        "q_lower": np.asarray(robot.q_lower),
        "q_upper": np.asarray(robot.q_upper),
        "tau_max": np.asarray(robot.tau_max),
        "collision": _barrier(leaves.collision),
        "self_collision": _barrier(leaves.self_collision),
        "joint_limit": _barrier(leaves.joint_limit.barrier),
        "obstacle_relaxation": _relaxation(ctrl.obstacle_relaxation),
        "limit_relaxation": _relaxation(ctrl.limit_relaxation),
        "posture": np.array(
            [posture.kq, posture.kd, posture.weight, ctrl.regularizer], float
        ),
        "table": np.array(TABLE_HEIGHT),
    }


def states(env: envs.ArmEnv, seed: int) -> dict[str, Any]:
    """A batch of states with set-points, five spheres, and our torques in float64."""
    robot = env.robot
    single = random_states(robot, BATCH, seed)
    with jax.enable_x64(True):
        q, qd, action, obstacles = jax.tree.map(double, single)
        spheres = obstacles.spheres
        obstacles = rmp.Obstacles.empty(spheres=len(spheres.radius), planes=1)
        obstacles = obstacles.with_spheres(spheres.center, spheres.radius).with_planes(
            [[0.0, 0.0, TABLE_HEIGHT]], [[0.0, 0.0, 1.0]]
        )
        obstacles = jax.tree.map(double, obstacles)
        setpoints = jax.vmap(env.controller.setpoint, in_axes=(0, 0, None))
        setpoint = jax.jit(setpoints)(q, action, 0.0)
        torques = {}
        for name, ctrl in (("rmp_vices", env.controller), ("vices", rmp.VICES(robot))):
            act = jax.jit(jax.vmap(ctrl, in_axes=(0, 0, 0, None)))
            torques[f"tau_{name}"] = act(q, qd, setpoint, obstacles).tau
        found = torques | {
            "q": q,
            "qd": qd,
            "p_des": setpoint.p_des,
            "R_des": setpoint.R_des,
            "kp": jnp.concatenate([setpoint.kp_pos, setpoint.kp_ori], axis=1),
            "spheres": jnp.concatenate(
                [spheres.center, spheres.radius[:, None]], axis=1
            ),
        }
        return {name: np.asarray(x) for name, x in found.items()}


def write(folder: Path, seed: int) -> None:
    """Write scene and arrays into a folder."""
    env = envs.load("trajectory", controller="rmp_vices", physics="mujoco")
    mujoco.mj_saveModel(env.scene.model, str(folder / SCENE))
    arm = {f"arm_{name}": x for name, x in arm_arrays(env).items()}
    np.savez(folder / ARRAYS, **arm, **states(env, seed))


def _barrier(leaf) -> np.ndarray:
    return np.array([getattr(leaf, field) for field in BARRIER], float)


def _relaxation(leaf) -> np.ndarray:
    return np.array([leaf.min_weight, leaf.near, leaf.far], float)
