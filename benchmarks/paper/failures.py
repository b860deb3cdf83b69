"""What each remaining event was: which bodies met, the hand or not, how hard."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import polars as pl

from envs.base import ArmEnv
from rmp_mjx.sim.base import pair_sensors
from rmp_mjx.training.evaluation.evaluate import Episodes
from rmp_mjx.training.evaluation.recording import MAX_STEPS, Recording

SCHEMA = {
    "episode": pl.Int64,
    "step": pl.Int64,
    "kind": pl.String,
    "first": pl.String,
    "second": pl.String,
    "hand": pl.Boolean,
    "gap": pl.Float64,
    "force": pl.Float64,
}
"""Columns: the episode, its length, the event's kind, what met what, whether the arm's
part was the hand, the distance at the end of the policy step [m, rad], and the greatest
normal force [N]."""

KINDS = ("collision", "self_collision", "joint_limit")
"""Events that end an episode."""
REACH = 1.0
"""Distances are looked for up to this [m]."""


def describe(env: ArmEnv, results: Episodes, tape: Recording) -> list[dict[str, Any]]:
    """Describe the events that ended recorded episodes.

    An episode ends with the policy step of its event. By then a contact may be over,
    so the event is put down to the pair of geoms, or the joint, nearest at the end.

    Args:
        env: The environment.
        results: Values of each episode.
        tape: The first episodes; those longer than the tape are left out.

    Returns:
        Rows of `SCHEMA`.
    """
    data = mujoco.MjData(env.scene.model)
    found = []
    for k, length in enumerate(tape.lengths):
        if results["length"][k] > MAX_STEPS:
            continue
        for kind in KINDS:
            if results[kind][k] > 0:
                state = tape.state(k, int(length))
                row = {"episode": k, "step": int(length), "kind": kind}
                row["force"] = float(results["contact_force_peak"][k])
                found.append(row | _met(env, data, state, kind))
    return found


def _met(env: ArmEnv, data: mujoco.MjData, state: Any, kind: str) -> dict[str, Any]:
    """What met what at the end of an episode."""
    if kind == "joint_limit":
        return _joint(env, np.asarray(state.data.qpos)[: env.robot.n])
    model, scene = env.scene.model, env.scene
    data.qpos[:] = np.asarray(state.data.qpos)
    if model.nmocap:
        data.mocap_pos[:] = np.asarray(state.data.mocap_pos)
    mujoco.mj_kinematics(model, data)
    concerned = scene.self_pairs if kind == "self_collision" else scene.hand | scene.arm
    sensors = np.array(pair_sensors(model))[concerned]
    pairs = [(model.sensor_objid[s], model.sensor_refid[s]) for s in sensors]
    gaps = [mujoco.mj_geomDistance(model, data, a, b, REACH, None) for a, b in pairs]
    nearest = int(np.argmin(gaps))
    first, second = (model.geom(geom).name for geom in pairs[nearest])
    hand = bool(scene.hand[concerned][nearest])
    return {"first": first, "second": second, "hand": hand, "gap": gaps[nearest]}


def _joint(env: ArmEnv, q: np.ndarray) -> dict[str, Any]:
    """The joint nearest to a limit."""
    room = np.stack([q - env.robot.q_lower, env.robot.q_upper - q])
    side, joint = np.unravel_index(np.argmin(room), room.shape)
    return {
        "first": f"joint {joint + 1}",
        "second": ("lower limit", "upper limit")[side],
        "hand": None,
        "gap": float(room[side, joint]),
    }
