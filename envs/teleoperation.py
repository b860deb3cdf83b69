"""A person in the place of the policy, and demonstrations of what it did."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rmp_mjx import runtime
from rmp_mjx.control.action import ACTION_SIZE, ActionRange
from rmp_mjx.control.controller import ImpedanceController
from rmp_mjx.math import mat_to_quat, orientation_error, quat_to_mat
from rmp_mjx.training import demonstrations
from rmp_mjx.training.demonstrations import Demonstrations
from rmp_mjx.training.runs import run_folder

from . import cli, registry
from .base import ArmEnv
from .play import Moment, Play
from .types import State

KP = 100.0
"""Stiffness to begin with [1/s^2]."""
FIELDS = ("observation", "action", "reward", "done", "success")
"""What is written of a step."""


class Wish(NamedTuple):
    """What a person asks of the hand."""

    position: np.ndarray
    """Where it is to be, (3,) [m]."""
    wxyz: np.ndarray
    """How it is to be turned, (4,)."""
    kp: float = KP
    """Stiffness along and about all axes [1/s^2]."""


def action_towards(
    span: ActionRange,
    p: Float[Array, " 3"],
    R: Float[Array, "3 3"],
    wish: Wish,
) -> Float[Array, " m"]:
    """The policy's action that brings the hand nearest to a wish.

    The way keeps its direction; it is as long as the action range allows.

    Args:
        span: What -1 and 1 mean.
        p: Where the hand is [m].
        R: How it is turned.
        wish: Where it is to be.
    """
    move = (jnp.asarray(wish.position) - p) / span.dpos
    turn = orientation_error(R, quat_to_mat(jnp.asarray(wish.wxyz))) / span.drot
    move, turn = (x / jnp.maximum(jnp.max(jnp.abs(x)), 1.0) for x in (move, turn))
    share = jnp.log(wish.kp / span.kp_min) / jnp.log(span.kp_max / span.kp_min)
    stiff = jnp.full(6, jnp.clip(2.0 * share - 1.0, -1.0, 1.0))
    others = jnp.zeros(span.size - ACTION_SIZE)  # the middle of the leaves' weights
    return jnp.concatenate([move, turn, stiff, others]).astype(jnp.float32)


class Teleoperation(Play):
    """Episodes of a task that a person drives, and those of them that are kept.

    A demonstration is a whole episode, from `record` to `keep` or `discard`. Until one
    of them is called, an episode that has ended stays as it is.
    """

    def __init__(self, env: ArmEnv, path: Path, seed: int = 0):
        """Nothing is compiled before the first step.

        Args:
            env: The task.
            path: Where the demonstrations go; the file is written anew at every `keep`.
            seed: Of the starts.

        Raises:
            ValueError: The controller has no action range that a pose could use.
        """
        controller = env.controller
        if not isinstance(controller, ImpedanceController):
            raise ValueError(f"{env.options.controller} is not driven by a pose")
        super().__init__(env, lambda obs, key: obs, seed, by_hand=0)
        self.path, self.recording = path, False
        self.kept: list[dict[str, np.ndarray]] = []
        """Columns of the demonstrations that were kept."""
        self._rows: dict[int, dict[str, Any]] = {}
        self._span = controller.action_range
        self._pose = jax.jit(lambda data: (env.site(data).p, env.site(data).R))
        self._action = jax.jit(partial(action_towards, self._span))
        self.wish = self.here(KP)

    @property
    def stiffnesses(self) -> tuple[float, float]:
        """Least and greatest stiffness [1/s^2]."""
        return float(self._span.kp_min), float(self._span.kp_max)

    def here(self, kp: float) -> Wish:
        """The wish to stay where the hand is."""
        p, R = self._pose(self.now.state.data)
        return Wish(np.asarray(p), np.asarray(mat_to_quat(R)), kp)

    @property
    def over(self) -> bool:
        """Whether the episode has ended."""
        state = self.now.state
        late = int(state.info["step"]) >= self.env.episode_length
        return late or bool(state.done > 0.5)

    @property
    def length(self) -> int:
        """Policy steps that the demonstration has so far."""
        return len(self._rows)

    def begin(self) -> None:
        """A new episode, in which the hand is to stay where it is."""
        super().begin()
        self.wish = self.here(self.wish.kp)

    def restore(self, frame: Moment) -> None:
        """Go on from a moment; a demonstration forgets what came after it."""
        again = frame.episode != self.now.episode
        super().restore(frame)
        self.wish = self.here(self.wish.kp)
        last = -1 if again else frame.steps
        self._rows = {k: row for k, row in self._rows.items() if k <= last}
        self.recording &= not again

    def intent(self, frame: Moment) -> Array:
        """The action that the wish asks for at a moment, (m,)."""
        return self._action(*self._pose(frame.state.data), self.wish)

    def advance(self, action: Array) -> State:
        """Where an action leads from now; recorded, it is a row."""
        new = super().advance(action)
        if self.recording:
            self._rows[self.now.steps + 1] = {
                "observation": np.asarray(self.now.state.obs),
                "action": np.asarray(action),
                "reward": np.asarray(new.reward),
                "done": np.asarray(new.done > 0.5),
                "success": np.asarray(new.metrics["success"] > 0.5),
            }
        return new

    def step(self) -> Moment:
        """One policy step, unless a demonstration waits to be kept or discarded."""
        return self.now if self.recording and self.over else super().step()

    def record(self) -> None:
        """Begin an episode that is to become a demonstration."""
        self._rows, self.recording = {}, True
        self.begin()

    def discard(self) -> None:
        """Forget the demonstration, and begin an episode."""
        self._rows, self.recording = {}, False
        self.begin()

    def keep(self) -> None:
        """Write the demonstration, after those that were kept, and begin an episode.

        Raises:
            ValueError: There is none.
        """
        if not self._rows:
            raise ValueError("nothing is recorded: press Record first")
        rows = self._rows.values()
        self.kept.append({n: np.stack([row[n] for row in rows]) for n in FIELDS})
        self.path.parent.mkdir(parents=True, exist_ok=True)
        demonstrations.write(self.path, self.demonstrations())
        self.discard()

    def demonstrations(self) -> Demonstrations:
        """All that were kept."""
        lengths = [len(columns["reward"]) for columns in self.kept]
        return Demonstrations(
            episode=np.repeat(np.arange(len(lengths)), lengths),
            step=np.concatenate([np.arange(n) for n in lengths]),
            about=demonstrations.describe(self.env, "teleoperation"),
            **{n: np.concatenate([each[n] for each in self.kept]) for n in FIELDS},
        )


def load(env: str, args: Sequence[str], folder: Path) -> Teleoperation:
    """A task to drive.

    Args:
        env: Name of the task.
        args: Flags of its options, as for `eval.py`.
        folder: Where the demonstrations go.

    Raises:
        ValueError: There is no such task or option.
    """
    options, _ = cli.parse_eval(["--env", env, "--agent", "zero", *args])
    runtime.configure()
    task = registry.make(dataclasses.replace(options.task, physics="mujoco"))
    name = f"{task.options.title}-{time.strftime('%Y-%m-%d-%H%M%S')}".replace(", ", "-")
    path = folder / f"{run_folder.name_of(name)}.parquet"
    return Teleoperation(task, path, options.seed)
