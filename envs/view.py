"""A policy in its task, in the browser: `python -m rmp_mjx.viewer --run RUN`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import viser
from rich.console import Console

from rmp_mjx.training.config import ConfigError
from rmp_mjx.viewer.clock_panel import ClockPanel
from rmp_mjx.viewer.drawing import Bodies, mesh_parts
from rmp_mjx.viewer.loop import Loop

from .base import ArmEnv
from .play import Moment, Play, load
from .types import State

DROPPED = (0.45, 0.0, 0.5)
"""Where a sphere is dropped, from the arm's base [m]."""


class TaskPage(Loop[Moment]):
    """The scene of a task, the policy's episodes, and spheres to drop."""

    def __init__(self, play: Play, title: str, port: int, folder: Path):
        """Start the server.

        Args:
            play: What is shown.
            title: Heading of the panel.
            port: Where the page is; the next free one if it is taken.
            folder: Where recordings go.
        """
        super().__init__(play, title, port, folder)
        self.play = play
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
        again = gui.add_button("New episode")
        self.clock = ClockPanel(self)
        drop = gui.add_button("Drop a sphere")
        clear = gui.add_button("Take the dropped spheres away")
        again.on_click(lambda _: self.order(self.play.begin))
        drop.on_click(lambda _: self.order(self.drop))
        clear.on_click(lambda _: self.order(self.clear))

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
        self._show_put(k, place)

    def _put(self, k: int, place: np.ndarray) -> None:
        if k in self._gizmos:
            self._show_put(k, place)

    def _show_put(self, k: int, place: np.ndarray | None) -> None:
        self.play.put(k, place)
        if self.player.paused:
            self.player.shown = self.play.now

    def clear(self) -> None:
        """Take the dropped spheres away."""
        for k, handle in self._gizmos.items():
            handle.remove()
            self._show_put(k, None)
        self._gizmos.clear()

    def refuse(self, error: ValueError) -> None:
        """Say why an order is not obeyed."""
        self.clock.saved.content = f"**{error}**"

    def draw(self, frame: Moment) -> None:
        """Show a moment in all browsers."""
        state = frame.state
        self._data.qpos[:] = np.asarray(state.data.qpos)
        if self._data.mocap_pos.size:
            self._data.mocap_pos[:] = np.asarray(state.data.mocap_pos)
        mujoco.mj_kinematics(self.play.env.scene.model, self._data)
        with self.server.atomic():
            self._bodies.move(self._data)
            self._draw_marks(state)
        events = ", ".join(f"{k} {v}" for k, v in frame.events.items()) or "none"
        self.status.content = (
            f"episode {frame.episode}, step {int(state.info['step'])} of "
            f"{self.play.env.episode_length}, return {frame.reward:.1f}  \n"
            f"policy steps with events: {events}"
        )
        self.clock.show()

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
