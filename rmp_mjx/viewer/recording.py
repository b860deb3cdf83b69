"""A recording of the scene: one HTML file that replays without a server."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import viser

from rmp_mjx.files import write_text


class Recording:
    """Starts, goes along with the pictures, and ends in a file."""

    def __init__(self, server: viser.ViserServer, folder: Path):
        """Nothing is recorded yet; the folder is made when it is needed."""
        self._server, self._folder = server, folder
        self._serializer: Any = None

    @property
    def on(self) -> bool:
        """Whether pictures are being recorded."""
        return self._serializer is not None

    def start(self) -> None:
        """Begin with the scene as it is now."""
        if not self.on:
            self._serializer = self._server.get_scene_serializer()

    def tick(self, seconds: float) -> None:
        """Let some time pass in the recording [s]."""
        if self._serializer is not None:
            self._serializer.insert_sleep(seconds)

    def save(self) -> Path:
        """End it; returns the file.

        Raises:
            ValueError: Nothing is being recorded.
        """
        if self._serializer is None:
            raise ValueError("nothing is being recorded")
        text = self._serializer.as_html()
        self._serializer = None
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._folder / time.strftime("%Y-%m-%d-%H%M%S.html")
        write_text(path, text)
        return path
