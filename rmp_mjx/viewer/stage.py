"""A session on a page: what the page's panels know and change."""

from __future__ import annotations

from pathlib import Path

from rmp_mjx.viewer.loop import Loop
from rmp_mjx.viewer.session import Frame, Session


class Stage(Loop[Frame]):
    """The part of a page that its panels know."""

    def __init__(self, session: Session, robot: str, port: int, folder: Path):
        """Start the server.

        Args:
            session: What is shown.
            robot: Name of its arm.
            port: Where the page is; the next free one if it is taken.
            folder: Where recordings go.
        """
        super().__init__(session, f"{robot}: what the tree thinks", port, folder)
        self.session, self.robot = session, robot
