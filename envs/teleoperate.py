"""A task that a person drives, in the browser: the viewer with `--teleoperate`."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from .play import Moment
from .scene import ASSETS
from .task_page import TaskPage
from .teleoperation import KP, Teleoperation, Wish, load

NUDGE, TURN, STIFFER = 0.02, 0.1, 1.25
"""A stroke of a key moves the target so far [m], with Shift it turns it [rad]; the
factor of the stiffness."""
KEYS: dict[Any, tuple[int, int]] = {
    "I": (0, 1),
    "K": (0, -1),
    "J": (1, 1),
    "L": (1, -1),
    "U": (2, 1),
    "O": (2, -1),
}
"""Keys, each with an axis of the world and a way; the camera has W, A, S, D, Q, E."""
GAMEPAD = (ASSETS / "gamepad.js").read_text()
"""Makes a gamepad's sticks and buttons strokes of the page's keys, in the browser."""


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
        self._key("R", "Record a demonstration", driven.record)
        self._key("T", "Keep it", driven.keep)
        self._key("X", "Discard it", driven.discard)
        self._key("N", "New episode", driven.discard)
        self._key("P", "Stiffer", partial(self.stiffen, STIFFER))
        self._key("M", "Softer", partial(self.stiffen, 1.0 / STIFFER))
        for key, (axis, way) in KEYS.items():
            along = f"{'-+'[way > 0]}{'xyz'[axis]}"
            move = partial(self.nudge, axis, way * NUDGE)
            turn = partial(self.turn, axis, way * TURN)
            self._key(key, f"Target along {along}", move)
            self._key(key, f"Target about {along}", turn, "shift")
        # A browser runs no script of an HTML element, but what handles its events.
        script = html.escape(f"{{ {GAMEPAD} }}")
        gui.add_html(f'<img src="data:," hidden onerror="{script}">')

    def _key(
        self, key: Any, label: str, what: Callable[[], object], modifier: Any = None
    ) -> None:
        """Let a key do something."""
        command = self.server.gui.add_command(label, hotkey=key, modifier=modifier)
        command.on_trigger(lambda _: self.order(what))

    def _aim(self) -> None:
        """What the gizmo and the slider ask for is asked of the hand."""
        place = np.array(self.target.position), np.array(self.target.wxyz)
        self.driven.wish = Wish(*place, float(self.kp.value))

    def turn(self, axis: int, angle: float) -> None:
        """Turn the target about an axis of the world [rad]."""
        turn, turned = np.zeros(4), np.zeros(4)
        mujoco.mju_axisAngle2Quat(turn, np.eye(3)[axis], angle)
        mujoco.mju_mulQuat(turned, turn, np.array(self.target.wxyz))
        self.target.wxyz = turned
        self._aim()

    def stiffen(self, factor: float) -> None:
        """Multiply the stiffness, within what the action range allows."""
        self.kp.value = float(np.clip(factor * self.kp.value, self.kp.min, self.kp.max))
        self._aim()

    def intent(self, frame: Moment) -> Any:
        """The action that the target asks for at a moment, (m,)."""
        return self.driven.intent(frame)

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
