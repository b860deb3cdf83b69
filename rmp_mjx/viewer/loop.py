"""A page: a server, what it plays, and the loop that serves it."""

from __future__ import annotations

import abc
import queue
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Generic

import numpy as np
import viser

from rmp_mjx.viewer.player import FrameT, Player, Simulation
from rmp_mjx.viewer.recording import Recording

HOST = "127.0.0.1"
"""A page can be opened from this machine only."""
FRAMES = 30.0
"""Pictures per second."""


class Loop(abc.ABC, Generic[FrameT]):
    """A server and a player, and `run`, which does everything in one thread.

    What users do arrives in other threads. It is put into a queue, and the loop obeys
    between two ticks.
    """

    frames = FRAMES
    """Pictures per second of this page."""

    def __init__(
        self, simulation: Simulation[FrameT], title: str, port: int, folder: Path
    ):
        """Start the server.

        Args:
            simulation: What is shown.
            title: Heading of the panel.
            port: Where the page is; the next free one if it is taken.
            folder: Where recordings go.
        """
        self.server = viser.ViserServer(host=HOST, port=port, verbose=False)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.gui.set_panel_label(title)
        self.server.scene.set_up_direction("+z")
        self.player = Player(simulation)
        self.folder = folder
        self.recording = Recording(self.server, folder)
        self._orders: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self._stop = threading.Event()

    @abc.abstractmethod
    def draw(self, frame: FrameT) -> None:
        """Show a frame in all browsers."""

    @abc.abstractmethod
    def render(self, frames: Sequence[FrameT]) -> list[np.ndarray]:
        """Frames drawn by MuJoCo, (height, width, 3) each; another thread may ask."""

    @abc.abstractmethod
    def refuse(self, error: ValueError) -> None:
        """Tell the users why an order is not obeyed."""

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self.server.get_port()}"

    def order(self, what: Callable[[], object]) -> None:
        """Let the loop do something between two steps; for other threads."""
        self._orders.put(what)

    def tick(self, elapsed: float) -> None:
        """Simulate what the wall clock asks for, and draw it.

        Args:
            elapsed: Wall time since the last call [s].
        """
        self.draw(self.player.advance(elapsed))
        self.recording.tick(1.0 / self.frames)

    def run(self, seconds: float | None = None) -> None:
        """Obey and tick until `stop`, or for so long [s]."""
        last = start = time.perf_counter()
        try:
            while not self._stop.is_set():
                now = time.perf_counter()
                if seconds is not None and now - start > seconds:
                    break
                self._obey()
                self.tick(now - last)
                last = now
                spent = time.perf_counter() - now
                self._stop.wait(max(0.0, 1.0 / self.frames - spent))
        finally:
            self.server.stop()

    def stop(self) -> None:
        """Let the loop end, and with it the server."""
        self._stop.set()

    def _obey(self) -> None:
        while not self._orders.empty():
            try:
                self._orders.get()()
            except ValueError as error:
                self.refuse(error)
