"""A session, its clock and its recording: what the panels of a page change."""

from __future__ import annotations

from pathlib import Path

from rmp_mjx.viewer.loop import Loop
from rmp_mjx.viewer.recording import Recording
from rmp_mjx.viewer.session import Frame, Session


class Stage(Loop):
    """The part of a page that its panels know."""

    def __init__(self, session: Session, robot: str, port: int, folder: Path):
        """Start the server.

        Args:
            session: What is shown.
            robot: Name of its arm.
            port: Where the page is; the next free one if it is taken.
            folder: Where recordings go.
        """
        super().__init__(f"{robot}: what the tree thinks", port)
        self.session, self.robot = session, robot
        self.paused, self.speed = False, 1.0
        self.back = 0.0
        """How long ago what is shown was, while paused [s]."""
        self.frame: Frame | None = None
        """What is shown."""
        self.recording = Recording(self.server, folder)

    def step_once(self) -> None:
        """Pause, and go on by one step."""
        self.paused, self.back = True, 0.0
        self.frame = self.session.step()
