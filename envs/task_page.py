"""A task in the browser: the scene of a moment of an episode, and its clock."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from rmp_mjx.viewer import film
from rmp_mjx.viewer.clock_panel import ClockPanel
from rmp_mjx.viewer.drawing import Bodies, Thoughts, mesh_parts
from rmp_mjx.viewer.insight import on_host
from rmp_mjx.viewer.loop import Loop
from rmp_mjx.viewer.player import Simulation
from rmp_mjx.viewer.tree_panel import TreePanel

from .base import ArmEnv
from .play import Moment
from .render import render
from .scene import ARM
from .thoughts import thinker
from .types import State

ROOT = "/task"
"""The node above the task's bodies."""
LAST = 1e9
"""Place in the panel: below all else."""


class TaskPage(Loop[Moment]):
    """The scene of a task, and the moments of a simulation in it."""

    def __init__(
        self,
        simulation: Simulation[Moment],
        env: ArmEnv,
        title: str,
        port: int,
        folder: Path,
    ):
        """Start the server.

        Args:
            simulation: What is shown.
            env: Its task.
            title: Heading of the panel.
            port: Where the page is; the next free one if it is taken.
            folder: Where recordings go.
        """
        super().__init__(simulation, title, port, folder)
        self.env = env
        model = env.scene.model
        self._data = mujoco.MjData(model)
        parts = mesh_parts(model, range(model.ngeom))
        self._bodies = Bodies(self.server.scene, model, ROOT, parts)
        self._marks: dict[tuple, Any] = {}
        eye, middle = _camera(env)
        self.server.initial_camera.position = eye
        self.server.initial_camera.look_at = middle
        self.status = self.server.gui.add_markdown("compiling ...")
        self.clock = ClockPanel(self)
        self._think = thinker(env)
        if self._think is not None:
            gui, title = self.server.gui, "What the tree thinks"
            with gui.add_folder(title, order=LAST, expand_by_default=False):
                scene, robot = self.server.scene, env.robot
                thoughts = Thoughts(scene, robot, model, ROOT, ARM)
                self.tree = TreePanel(self, thoughts, on=False)

    @abc.abstractmethod
    def intent(self, frame: Moment) -> Any:
        """The action that is taken at a moment, (m,)."""

    def refuse(self, error: ValueError) -> None:
        """Say why an order is not obeyed."""
        self.clock.saved.content = f"**{error}**"

    def draw(self, frame: Moment) -> None:
        """Show a moment in all browsers."""
        state = frame.state
        self._data.qpos[:] = np.asarray(state.data.qpos)
        if self._data.mocap_pos.size:
            self._data.mocap_pos[:] = np.asarray(state.data.mocap_pos)
        mujoco.mj_kinematics(self.env.scene.model, self._data)
        with self.server.atomic():
            self._bodies.move(self._data)
            self._draw_marks(state)
        self._draw_thoughts(frame)
        events = ", ".join(f"{k} {v}" for k, v in frame.events.items()) or "none"
        self.status.content = (
            f"episode {frame.episode}, step {int(state.info['step'])} of "
            f"{self.env.episode_length}, return {frame.reward:.1f}  \n"
            f"policy steps with events: {events}"
        )
        self.clock.show()

    def render(self, frames: Sequence[Moment]) -> list[np.ndarray]:
        """Moments drawn by MuJoCo, with the task's marks."""
        return render(self.env, [frame.state for frame in frames], film.SIZE, False)

    def _draw_thoughts(self, frame: Moment) -> None:
        """What the tree thinks, if anybody wants to see it: it takes time."""
        if self._think is None:
            return
        if not self.tree.thoughts.wanted:
            self.tree.hide()
            return
        if not self.tree.bars.content:
            self.tree.bars.content = "compiling ..."
        insight = on_host(self._think(frame.state, self.intent(frame)))
        with self.server.atomic():
            self.tree.show(insight, self.env.options.controller)

    def _draw_marks(self, state: State) -> None:
        shown = {}
        for k, mark in enumerate(self.env.marks(state)):
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
