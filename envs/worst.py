"""The worst episodes of an evaluation: which they are, kept step by step to look at."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from rmp_mjx.files import write_text
from rmp_mjx.metric import SUCCESS
from rmp_mjx.training.evaluation import evaluate, film
from rmp_mjx.training.evaluation.evaluate import Episodes
from rmp_mjx.training.evaluation.recording import Recording
from rmp_mjx.training.learning import devices, faults
from rmp_mjx.training.learning.networks import Agent
from rmp_mjx.training.learning.rollout import Env
from rmp_mjx.training.runs import run_folder
from rmp_mjx.trees import named_leaves, numbers

from . import registry
from .base import ArmEnv
from .types import State

NEAREST = 5
"""Episodes kept for their least clearance."""
MOST = 20
"""Episodes kept for an event, and for a stall, at most; the nearest ones first."""
STALL = 2.0
"""An arm stalls if so long [s]..."""
STILL = 0.02
"""...no joint moves by so much [rad], and the task is not solved."""
MEMORY = 128 * 2**20
"""For the steps of all episodes; of a long evaluation only the first ones fit
[bytes]."""
CLEARANCE, LOST, STALLED = "clearance", "lost", "stall"
"""What happens besides the events."""


class Case(NamedTuple):
    """An episode, and what is bad about it."""

    episode: int
    """Its number in the evaluation, from 0."""
    moments: dict[str, int]
    """What happened, and after how many policy steps for the first time."""
    clearance: float
    """Its least clearance [m]."""

    @property
    def opened(self) -> int:
        """The step to look at: an event's, else a stall's, else the nearest one's."""
        events = [k for n, k in self.moments.items() if n not in (CLEARANCE, STALLED)]
        return min(events) if events else self.moments.get(STALLED, self.nearest)

    @property
    def nearest(self) -> int:
        """The step of the least clearance."""
        return self.moments[CLEARANCE]


def thin(state: State, action: Array) -> State:
    """What is kept of a step: all that is shown of a state, and the next action."""
    data = state.data.replace(sensors=state.data.sensors[..., :0])
    info = {k: v for k, v in state.info.items() if k != "control"}
    return state.replace(data=data, info=info | {"action": action})


def template(env: ArmEnv) -> State:
    """Shapes of one step as it is kept."""
    action = jax.ShapeDtypeStruct((env.action_size,), jnp.float32)
    key = jax.eval_shape(jax.random.key, 0)
    return jax.eval_shape(lambda key, a: thin(env.reset(key), a), key, action)


def count(env: ArmEnv, episodes: int) -> int:
    """How many of an evaluation's episodes `MEMORY` holds."""
    each = devices.size(template(env)) * (env.episode_length + 1)
    return min(episodes, max(1, int(MEMORY // each)))


def recorder(
    env: Env, episodes: int, video: bool
) -> Callable[[Agent, PRNGKeyArray], tuple[Episodes, Recording]]:
    """The evaluation that keeps the steps of its first episodes, for `save`.

    Args:
        env: The task; one that is no arm's keeps none.
        episodes: Number of episodes.
        video: Whether the recording must do for a video.
    """
    filmed = film.EPISODES if video else 0
    if not isinstance(env, ArmEnv):
        return evaluate.recorder(env, episodes, filmed)
    kept = max(filmed, count(env, episodes))
    return evaluate.recorder(env, episodes, kept, thin, env.episode_length)


def choose(env: ArmEnv, tape: Recording, results: Episodes) -> list[Case]:
    """The episodes to keep, the one with the least clearance first.

    Args:
        env: The task.
        tape: Its first episodes, of steps that are `thin`.
        results: Values of every episode.
    """
    cases = [_case(env, tape, results, k) for k in range(tape.count)]
    cases.sort(key=lambda case: case.clearance)
    stalled = [case for case in cases if STALLED in case.moments]
    others = {CLEARANCE, STALLED}
    eventful = [case for case in cases if case.moments.keys() - others]
    wanted = (cases[:NEAREST], eventful[:MOST], stalled[:MOST])
    chosen = {case.episode for part in wanted for case in part}
    return [case for case in cases if case.episode in chosen]


def _case(env: ArmEnv, tape: Recording, results: Episodes, episode: int) -> Case:
    """What happened in an episode."""
    length = int(tape.lengths[episode])

    def steps(x: np.ndarray) -> np.ndarray:
        return x[1 : length + 1, episode]

    metrics = {name: steps(x) for name, x in tape.states.metrics.items()}
    moments = {CLEARANCE: 1 + int(np.argmin(metrics[CLEARANCE]))}
    for name, metric in env.metrics.items():
        if metric.event and metrics[name].any():
            moments[name] = 1 + int(np.argmax(metrics[name] > 0))
    if results["lost"][episode]:
        moments[LOST] = length
    q = tape.states.data.qpos[: length + 1, episode, : env.robot.n]
    stall = stalled(q, metrics[SUCCESS.name] > 0, round(STALL / env.dt))
    if stall is not None:
        moments[STALLED] = stall
    return Case(episode, moments, float(results[CLEARANCE][episode]))


def stalled(q: np.ndarray, solved: np.ndarray, window: int) -> int | None:
    """The step at which the arm first stalls; None: it does not.

    Args:
        q: Joint positions before and after each of t steps, (t + 1, n) [rad].
        solved: Whether the task is solved after each step, (t,).
        window: Steps in `STALL`.
    """
    if len(solved) < window:
        return None
    moved = np.abs(q[window:] - q[:-window]).max(axis=1)
    solutions = np.concatenate([[0], np.cumsum(solved)])
    still = (moved < STILL) & (solutions[window:] == solutions[:-window])
    return int(np.argmax(still)) if still.any() else None


def save(env: Env, tape: Recording, results: Episodes, folder: Path) -> list[Case]:
    """Write the worst episodes into a folder, in place of those before.

    Args:
        env: The task; one that is no arm's has none.
        tape: What `recorder` returned.
        results: Values of every episode.
        folder: The run's.

    Returns:
        What was kept.
    """
    if not isinstance(env, ArmEnv):
        return []
    cases, place = choose(env, tape, results), folder / run_folder.WORST
    place.mkdir(parents=True, exist_ok=True)
    for old in place.glob("*.npz"):
        old.unlink()
    lines = []
    for case in cases:
        k = case.episode
        about = {
            "episode": k,
            "moments": {n: round(t * env.dt, 6) for n, t in case.moments.items()},
            "opened": round(case.opened * env.dt, 6),
            "clearance": case.clearance,
            "return": float(results["return"][k]),
        }
        file = place / f"{k:05d}.npz"
        own = jax.tree.map(lambda x, k=k: x[: tape.lengths[k] + 1, k], tape.states)
        arrays: dict[str, Any] = dict(named_leaves(own))
        record = {"task": env.options.record(), **about}
        arrays[faults.ABOUT] = np.array(json.dumps(record))
        np.savez_compressed(file, **arrays)
        lines.append({"file": file.name, **about})
    index = {"episodes": len(results["return"]), "searched": tape.count, "kept": lines}
    write_text(folder / run_folder.WORST_INDEX, json.dumps(index, indent=2) + "\n")
    return cases


@dataclasses.dataclass(frozen=True)
class Kept:
    """An episode from a file."""

    env: ArmEnv
    """The task, in MuJoCo C."""
    states: list[State]
    """Steps as `thin` keeps them, NumPy, the start included."""
    about: Mapping[str, Any]
    """Episode, moments [s], clearance [m], return."""

    @property
    def opened(self) -> int:
        """The policy step to look at."""
        return round(self.about["opened"] / self.env.dt)


def about(path: Path) -> dict[str, Any]:
    """What a file says of its episode.

    Raises:
        ValueError: It was not written by `save`.
    """
    wanted = ("task", "episode", "moments", "opened", "clearance", "return")
    try:
        with np.load(path) as stored:
            found = json.loads(str(stored[faults.ABOUT]))
        return {name: found[name] for name in wanted}
    except faults.UNREADABLE as error:
        raise ValueError(f"{path} is no episode of an evaluation: {error}") from error


def load(path: Path, env: ArmEnv | None = None) -> Kept:
    """Read an episode.

    Args:
        path: A file of `save`.
        env: Its task, if that has been made.

    Raises:
        ValueError: It is no such file, or damaged.
    """
    record = about(path)
    if env is None:
        options = registry.recorded(record["task"])
        env = registry.make(dataclasses.replace(options, physics="mujoco"))
    shapes = template(env)
    wanted = named_leaves(jax.eval_shape(numbers, shapes))
    try:
        with np.load(path) as stored:
            leaves = {name: stored[name] for name in wanted}
    except faults.UNREADABLE as error:
        raise ValueError(f"{path} is damaged, or of another task: {error}") from error
    for name, leaf in wanted.items():
        if leaves[name].shape[1:] != leaf.shape:
            raise ValueError(f"{path} is of another task: {name} has another shape")
    tree, values = jax.tree.structure(shapes), [*leaves.values()]
    steps = range(len(values[0]))
    states = [jax.tree.unflatten(tree, [x[t] for x in values]) for t in steps]
    return Kept(env, states, record)
