"""Deploy a trained cell in a column: every episode's values into the store."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import polars as pl
from rich.console import Console

from benchmarks.common import machine
from benchmarks.paper import cells, store
from benchmarks.paper.cells import COLUMNS, PICTURED, TABLE, Cell, Column, Preset
from benchmarks.paper.store import Store
from envs.base import ArmEnv
from envs.safety import ENDING
from rmp_mjx import runtime
from rmp_mjx.metric import reductions
from rmp_mjx.sim.base import pair_sensors
from rmp_mjx.training.config import TrainConfig
from rmp_mjx.training.evaluation import evaluate, film
from rmp_mjx.training.evaluation.evaluate import Episodes
from rmp_mjx.training.evaluation.recording import MAX_STEPS, Recording
from rmp_mjx.training.policy import load_policy

STARTS = 2000
"""Seed of the episodes: the same in every cell, so that all meet the same worlds."""
RECORDED = 100
"""Episodes of the pictured column that are recorded."""
ALIKE = {"terminate_on_event": True}
"""Options that no training may change: every deployed episode ends with an event."""


def deployed(config: TrainConfig, column: Column) -> TrainConfig:
    """A training's configuration with the world of a column."""
    physics = column.physics or config.task.physics
    return config.replace(**column.options, **ALIKE, physics=physics)


def definition(preset: Preset, cell: Cell, column: Column) -> dict[str, Any]:
    """What a deployment depends on."""
    variant = cells.VARIANTS[cell.variant]
    options = preset.options, variant.options, column.options, ALIKE
    return {
        "training": cells.definition(preset, cell),
        "env_options": cells.texts(*options),
        "physics": deployed(preset.config(cell), column).task.physics,
        "episodes": episodes(preset, column),
        "starts": STARTS,
    }


def episodes(preset: Preset, column: Column) -> int:
    """Episodes of a column."""
    return preset.episodes if column.name in TABLE else preset.other_episodes


def is_deployed(place: Store, preset: Preset, cell: Cell, name: str) -> bool:
    """Whether a deployment is in the store."""
    wanted = definition(preset, cell, COLUMNS[name])
    found = place.holds(wanted, store.EPISODES, cell, name)
    if name == PICTURED:
        found &= place.holds(wanted, store.EVENTS, cell, name)
    return found


def deploy(
    place: Store, preset: Preset, cell: Cell, name: str, console: Console
) -> None:
    """Run a trained cell's mean policy in a column.

    Raises:
        PolicyError: The policy's file is missing or damaged.
    """
    column, config = COLUMNS[name], preset.config(cell)
    count = episodes(preset, column)
    filmed = min(RECORDED, count) if name == PICTURED else 0
    env, record = _recorder(deployed(config, column), count, filmed)
    policy = load_policy(place.policy(cell))
    agent = policy.agent(env.observation_size, env.action_size, True)
    began = time.monotonic()
    results, tape = record(agent, jax.random.key(STARTS))
    about = {
        "definition": definition(preset, cell, column),
        "seconds": time.monotonic() - began,
        "training_iterations": policy.about["iterations"],
        "dt": env.dt,
        "reductions": reductions(env.metrics),
        "date": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "machine": machine(),
    }
    if filmed:
        events = describe(env, results, tape)
        save(env, tape, events, folder(place, cell), console)
        place.write(pl.DataFrame(events, SCHEMA), about, store.EVENTS, cell, name)
    values = {key: np.asarray(each, np.float32) for key, each in results.items()}
    place.write(pl.DataFrame(values), about, store.EPISODES, cell, name)


@functools.lru_cache(maxsize=64)
def _world(config: TrainConfig, count: int, filmed: int):
    env = cells.load(config)
    return env, evaluate.recorder(env, count, filmed)


def _recorder(config: TrainConfig, count: int, filmed: int):
    """The task of a configuration and its recorder, compiled once for all seeds."""
    return _world(config.replace(seed=0), count, filmed)


INSTANCE, STORYBOARD = "instance.png", "storyboard.png"
FAILURES = 3
"""Ends of failed episodes that are drawn."""


def folder(place: Store, cell: Cell) -> Path:
    """Where a cell's pictures are."""
    return place.folder / "pictures" / cell.file


def failure(number: int) -> str:
    """File of the end of a failed episode."""
    return f"event{number}.png"


def save(
    env: Any,
    tape: Recording,
    events: Sequence[Mapping[str, Any]],
    place: Path,
    console: Console,
) -> None:
    """Draw the first episode and the ends of the first that failed, or say why not.

    Args:
        env: The environment.
        tape: Recorded episodes.
        events: Rows of `describe`.
        place: Where the files go.
        console: Terminal.
    """
    if runtime.choose_gl() is None:
        console.print("no pictures: no headless rendering here")
        return
    try:
        import mediapy

        from envs.render import render  # loads graphics libraries

        draw = partial(render, env)
        place.mkdir(parents=True, exist_ok=True)
        (instance,) = draw([tape.state(0, 0)], film.LARGE, True)
        mediapy.write_image(place / INSTANCE, instance)
        mediapy.write_image(place / STORYBOARD, film.storyboard(draw, tape))
        ends = [tape.state(row["episode"], row["step"]) for row in events[:FAILURES]]
        stills = draw(ends, film.SMALL, True) if ends else []
        for number, still in enumerate(stills):
            mediapy.write_image(place / failure(number), still)
    except Exception as error:  # graphics stacks fail in many ways; numbers are safe
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        console.print(f"no pictures: {reason}", markup=False, highlight=False)


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
        for kind in ENDING:
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
