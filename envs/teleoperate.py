"""A task that a person drives, in the browser: the viewer with `--teleoperate`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .play import Moment
from .task_page import TaskPage
from .teleoperation import KP, Teleoperation, Wish, load

NUDGE = 0.02
"""Distance that the target moves with every stroke of a key [m]."""
KEYS: dict[Any, tuple[int, float]] = {
    "I": (0, NUDGE),
    "K": (0, -NUDGE),
    "J": (1, NUDGE),
    "L": (1, -NUDGE),
    "U": (2, NUDGE),
    "O": (2, -NUDGE),
}
"""Keys, each with an axis of the world and a step; the camera has W, A, S, D, Q, E."""


class DrivePage(TaskPage):
    """The scene of a task, a target for the hand, and buttons for demonstrations."""

    def __init__(self, play: Teleoperation, title: str, port: int, folder: Path):
        """Start the server; see `TaskPage`."""
        super().__init__(play, play.env, title, port, folder)
        self.driven, self._episode = play, 0
        gui, driven = self.server.gui, play
        self.told = gui.add_markdown("")
        low, high = driven.stiffnesses
        self.kp = gui.add_slider("Stiffness", low, high, 1.0, KP)
        record = gui.add_button("Record a demonstration")
        keep, discard = gui.add_button("Keep it"), gui.add_button("Discard it")
        again = gui.add_button("New episode")
        self.target = self.server.scene.add_transform_controls(
            "/target", scale=0.14, depth_test=False
        )
        self.server.scene.add_icosphere("/target/ball", 0.015, (26, 110, 190))
        self.target.on_update(lambda _: self.order(self._aim))
        self.kp.on_update(lambda _: self.order(self._aim))
        record.on_click(lambda _: self.order(driven.record))
        keep.on_click(lambda _: self.order(driven.keep))
        discard.on_click(lambda _: self.order(driven.discard))
        again.on_click(lambda _: self.order(driven.discard))
        for key, (axis, way) in KEYS.items():
            label = f"Target {'-+'[way > 0]}{'xyz'[axis]}"
            command = gui.add_command(label, hotkey=key)
            command.on_trigger(
                lambda _, axis=axis, way=way: self.order(lambda: self.nudge(axis, way))
            )

    def _aim(self) -> None:
        """What the gizmo and the slider ask for is asked of the hand."""
        place = np.array(self.target.position), np.array(self.target.wxyz)
        self.driven.wish = Wish(*place, float(self.kp.value))

    def nudge(self, axis: int, way: float) -> None:
        """Move the target along an axis of the world [m]."""
        place = np.array(self.target.position)
        place[axis] += way
        self.target.position = place
        self._aim()

    def draw(self, frame: Moment) -> None:
        """Show a moment; the target of a new episode is where the hand is."""
        super().draw(frame)
        driven = self.driven
        if frame.episode != self._episode:
            self._episode = frame.episode
            self.target.position = driven.wish.position
            self.target.wxyz = driven.wish.wxyz
        self.told.content = said(driven)


def said(driven: Teleoperation) -> str:
    """A line about the demonstrations."""
    kept = f"{len(driven.kept)} kept in `{driven.path}`" if driven.kept else "none kept"
    if not driven.recording:
        return f"not recording; {kept}"
    end = "it has ended: keep or discard it" if driven.over else "recording"
    return f"{end}, {driven.length} steps; {kept}"


def page(env: str, args: Sequence[str], port: int, folder: Path) -> DrivePage:
    """The page of a task that a person drives.

    Args:
        env: Name of the task.
        args: Flags of its options, as for `eval.py`.
        port: Where the page is.
        folder: Where demonstrations and recordings go.

    Raises:
        ValueError: There is no such task or option.
    """
    driven = load(env, args, folder)
    return DrivePage(driven, driven.env.options.title, port, folder)
