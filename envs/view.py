"""A policy in its task, in the browser: `python -m rmp_mjx.viewer --run RUN`."""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import viser
from rich.console import Console

from rmp_mjx import runtime
from rmp_mjx.training.config import ConfigError
from rmp_mjx.viewer.drawing import Bodies, mesh_parts
from rmp_mjx.viewer.loop import FRAMES, Loop
from rmp_mjx.viewer.recording import Recording

from . import cli, registry
from .base import ArmEnv
from .eval import agent_of
from .spheres import AWAY
from .types import State

BY_HAND = 3
"""Spheres that users can drop into a task, besides its own."""
REMEMBERED = 30.0
"""Length of the history [s]."""
DROPPED = (0.45, 0.0, 0.5)
"""Where a sphere is dropped, from the arm's base [m]."""


class Play:
    """One environment and its agent: episodes, one after the other."""

    def __init__(
        self, env: ArmEnv, agent: Callable[[Any, Any], Any], seed: int, by_hand: int
    ):
        """Nothing is compiled before the first step.

        Args:
            env: The task; its last `by_hand` spheres are not there at the start.
            agent: Who acts.
            seed: Of the starts.
            by_hand: Number of spheres that users can drop.
        """
        self.env, self.by_hand = env, by_hand
        self._key = jax.random.key(seed)
        self._reset = jax.jit(env.reset)
        self._step = jax.jit(partial(_step, env, agent))
        self.history: collections.deque[State] = collections.deque(
            maxlen=round(REMEMBERED / env.dt)
        )
        self.episode, self.reward = 0, 0.0
        self.events: dict[str, int] = {}
        self.begin()

    def begin(self) -> None:
        """A new episode; dropped spheres stay where they are."""
        kept = self.dropped if self.episode else {}
        self.episode += 1
        self.state = self._reset(jax.random.fold_in(self._key, self.episode))
        self.reward, self.events = 0.0, {}
        for k in range(self.by_hand):
            self.put(k, kept.get(k))

    @property
    def dropped(self) -> dict[int, np.ndarray]:
        """Places of the dropped spheres by their numbers [m]."""
        first = self.env.options.obstacles - self.by_hand
        there = np.asarray(self.state.info["spheres"].placed)[first:]
        places = np.asarray(self.state.data.mocap_pos)[first:]
        return {int(k): places[k] for k in np.flatnonzero(there)}

    def put(self, k: int, place: Sequence[float] | np.ndarray | None) -> None:
        """Drop sphere k at a place [m]; None: take it away."""
        slot = self.env.options.obstacles - self.by_hand + k
        state, spheres = self.state, self.state.info["spheres"]
        where = jnp.asarray(AWAY if place is None else place, jnp.float32)
        spheres = spheres.replace(
            placed=spheres.placed.at[slot].set(place is not None),
            velocity=spheres.velocity.at[slot].set(0.0),
        )
        data = state.data
        data = data.replace(mocap_pos=data.mocap_pos.at[slot].set(where))
        self.state = state.replace(data=data, info=state.info | {"spheres": spheres})

    def step(self) -> State:
        """One policy step; an episode that has ended makes room for the next."""
        over = int(self.state.info["step"]) >= self.env.episode_length
        if over or float(self.state.done):
            self.begin()
        key = jax.random.fold_in(self._key, len(self.history))
        self.state = self._step(self.state, key)
        self.reward += float(self.state.reward)
        for name in ("success", "collision", "self_collision", "joint_limit"):
            if float(self.state.metrics.get(name, 0.0)):
                self.events[name] = self.events.get(name, 0) + 1
        self.history.append(self.state)
        return self.state


def _step(env: ArmEnv, agent: Any, state: State, key: Any) -> State:
    return env.step(state, agent(state.obs[None], key)[0])


class TaskPage(Loop):
    """The scene of a task, the policy's episodes, and spheres to drop."""

    def __init__(self, play: Play, title: str, port: int, folder: Path):
        """Start the server.

        Args:
            play: What is shown.
            title: Heading of the panel.
            port: Where the page is; the next free one if it is taken.
            folder: Where recordings go.
        """
        super().__init__(title, port)
        self.play, self.state = play, play.state
        self.paused, self.speed, self.back, self._owed = False, 1.0, 0.0, 0.0
        self.recording = Recording(self.server, folder)
        model = play.env.scene.model
        self._data = mujoco.MjData(model)
        parts = mesh_parts(model, range(model.ngeom))
        self._bodies = Bodies(self.server.scene, model, "/task", parts)
        self._marks: dict[tuple, Any] = {}
        self._gizmos: dict[int, viser.TransformControlsHandle] = {}
        eye, middle = _camera(play.env)
        self.server.initial_camera.position = eye
        self.server.initial_camera.look_at = middle
        self._panel()

    def _panel(self) -> None:
        gui = self.server.gui
        self.status = gui.add_markdown("compiling ...")
        again, pause = gui.add_button("New episode"), gui.add_button("Pause")
        speed = gui.add_slider("Speed", 0.1, 1.0, 0.1, 1.0)
        back = gui.add_slider("Seconds ago", 0.0, REMEMBERED, self.play.env.dt, 0.0)
        drop = gui.add_button("Drop a sphere")
        clear = gui.add_button("Take the dropped spheres away")
        record = gui.add_button("Record")
        self.saved = gui.add_markdown("")

        def toggle() -> None:
            self.paused = not self.paused
            pause.label = "Go on" if self.paused else "Pause"
            if not self.paused:
                back.value = 0.0

        def scrub() -> None:
            self.back = float(back.value)
            if self.back and not self.paused:
                toggle()

        def save() -> None:
            if self.recording.on:
                self.saved.content = f"Saved `{self.recording.save()}`"
            else:
                self.recording.start()
            record.label = "Stop and save" if self.recording.on else "Record"

        again.on_click(lambda _: self.order(self.play.begin))
        pause.on_click(lambda _: self.order(toggle))
        speed.on_update(lambda _: setattr(self, "speed", float(speed.value)))
        back.on_update(lambda _: self.order(scrub))
        drop.on_click(lambda _: self.order(self.drop))
        clear.on_click(lambda _: self.order(self.clear))
        record.on_click(lambda _: self.order(save))

    def drop(self) -> None:
        """Put one more sphere into the task.

        Raises:
            ValueError: All of them are there.
        """
        free = [k for k in range(self.play.by_hand) if k not in self._gizmos]
        if not free:
            raise ValueError(f"there can be at most {self.play.by_hand} more spheres")
        k, place = free[0], np.array(DROPPED) + self.play.env.mount
        handle = self.server.scene.add_transform_controls(
            f"/dropped/{k}", scale=0.14, disable_rotations=True, position=place
        )
        self._gizmos[k] = handle
        handle.on_update(
            lambda _: self.order(lambda: self._put(k, np.array(handle.position)))
        )
        self.play.put(k, place)

    def _put(self, k: int, place: np.ndarray) -> None:
        if k in self._gizmos:
            self.play.put(k, place)

    def clear(self) -> None:
        """Take the dropped spheres away."""
        for k, handle in self._gizmos.items():
            handle.remove()
            self.play.put(k, None)
        self._gizmos.clear()

    def refuse(self, error: ValueError) -> None:
        """Say why an order is not obeyed."""
        self.saved.content = f"**{error}**"

    def tick(self, elapsed: float) -> None:
        """Take the policy steps that are due, and draw."""
        play = self.play
        if not self.paused:
            self._owed += min(elapsed, 2.0 * play.env.dt) * self.speed
            while self._owed >= play.env.dt:
                self._owed -= play.env.dt
                self.state = play.step()
        elif play.history:
            ago = min(round(self.back / play.env.dt), len(play.history) - 1)
            self.state = play.history[-1 - ago]
        self._draw(self.state)
        self.recording.tick(1.0 / FRAMES)

    def _draw(self, state: State) -> None:
        self._data.qpos[:] = np.asarray(state.data.qpos)
        if self._data.mocap_pos.size:
            self._data.mocap_pos[:] = np.asarray(state.data.mocap_pos)
        mujoco.mj_kinematics(self.play.env.scene.model, self._data)
        with self.server.atomic():
            self._bodies.move(self._data)
            self._draw_marks(state)
        events = ", ".join(f"{k} {v}" for k, v in self.play.events.items()) or "none"
        self.status.content = (
            f"episode {self.play.episode}, step {int(state.info['step'])} of "
            f"{self.play.env.episode_length}, return {self.play.reward:.1f}  \n"
            f"policy steps with events: {events}"
        )

    def _draw_marks(self, state: State) -> None:
        shown = {}
        for k, mark in enumerate(self.play.env.marks(state)):
            key = (k, mark.shape, mark.radius, tuple(mark.color))
            shown[key] = self._marks.get(key) or self._mark(k, mark)
            shown[key].position = mark.place
        for key in self._marks.keys() - shown.keys():
            self._marks[key].visible = False
        for key, handle in shown.items():
            self._marks[key] = handle
            handle.visible = True

    def _mark(self, k: int, mark: Any) -> Any:
        color = np.array([255 * c for c in mark.color[:3]], np.uint8)
        name = f"/marks/{k}/{len(self._marks)}"
        add = self.server.scene
        if mark.shape == "ball":
            return add.add_icosphere(name, mark.radius, color)
        return add.add_cylinder(name, mark.radius, 0.002, color)


def _camera(env: ArmEnv) -> tuple[np.ndarray, np.ndarray]:
    """Where the camera is, and what it looks at: the task's view."""
    middle, distance, azimuth, elevation = env.view
    a, e = np.deg2rad(azimuth), np.deg2rad(elevation)
    ahead = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    middle = np.asarray(middle, float)
    return middle - distance * ahead, middle


def load(args: Sequence[str]) -> tuple[Play, str]:
    """The task and the policy that flags of `eval.py` name, and a title.

    Raises:
        ValueError: They name none.
    """
    options, config = cli.parse_eval(args)
    runtime.configure()
    slots = options.task.obstacles + BY_HAND
    task = dataclasses.replace(options.task, obstacles=slots, physics="mujoco")
    env = registry.make(task)
    _, agent = agent_of(dataclasses.replace(options, task=task), config, env, Console())
    return Play(env, agent, options.seed, BY_HAND), f"{options.agent}: {task.title}"


def main(
    args: Sequence[str], port: int, folder: Path, seconds: float | None = None
) -> int:
    """Show a policy in its task; returns the exit code.

    Args:
        args: Flags of `eval.py`.
        port: Where the page is.
        folder: Where recordings go.
        seconds: End after so long; None: never.
    """
    try:
        play, title = load(args)
        page = TaskPage(play, title, port, folder)
    except (ConfigError, ValueError, OSError) as error:
        Console(stderr=True).print(f"error: {error}", markup=False, highlight=False)
        return 2
    Console().print(f"open {page.url}, end with Ctrl+C", markup=False, highlight=False)
    page.run(seconds)
    return 0
