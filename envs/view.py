"""A policy in its task, in the browser: `python -m rmp_mjx.viewer --run RUN`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import viser

from .play import Moment, Play, load
from .task_page import TaskPage

DROPPED = (0.45, 0.0, 0.5)
"""Where a sphere is dropped, from the arm's base [m]."""


class PolicyPage(TaskPage):
    """A policy's episodes, and spheres to drop."""

    def __init__(self, play: Play, title: str, port: int, folder: Path):
        """Start the server.

        Args:
            play: What is shown.
            title: Heading of the panel.
            port: Where the page is; the next free one if it is taken.
            folder: Where recordings go.
        """
        super().__init__(play, play.env, title, port, folder)
        self.play = play
        self._gizmos: dict[int, viser.TransformControlsHandle] = {}
        gui = self.server.gui
        again = gui.add_button("New episode")
        drop = gui.add_button("Drop a sphere")
        clear = gui.add_button("Take the dropped spheres away")
        again.on_click(lambda _: self.order(self.play.begin))
        drop.on_click(lambda _: self.order(self.drop))
        clear.on_click(lambda _: self.order(self.clear))

    def intent(self, frame: Moment) -> Any:
        """The action that the policy takes at a moment, (m,)."""
        return self.play.intent(frame)

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


def page(args: Sequence[str], port: int, folder: Path) -> PolicyPage:
    """The page of a policy in its task.

    Args:
        args: Flags of `eval.py`.
        port: Where the page is.
        folder: Where recordings go.

    Raises:
        ValueError: The flags name no policy, or no task.
    """
    play, title = load(args)
    return PolicyPage(play, title, port, folder)
