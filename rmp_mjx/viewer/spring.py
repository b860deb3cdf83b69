"""A hand that pulls a link by a spring: its handle, its force, its arrow."""

from __future__ import annotations

import numpy as np
import viser

from rmp_mjx.viewer.stage import Stage

STIFFNESS = 200.0
"""Of the spring from the link to the handle [N/m]."""
STRONGEST = 60.0
"""Its greatest force [N]."""
COLOR = (200, 30, 150)
"""Of the arrow."""


def pull(link: np.ndarray, handle: np.ndarray) -> np.ndarray:
    """Force of the spring, (3,) [N].

    Args:
        link: Where it acts, (3,) [m].
        handle: Where it is pulled to, (3,) [m].
    """
    force = STIFFNESS * (handle - link)
    size = float(np.linalg.norm(force))
    return force * min(1.0, STRONGEST / max(size, 1e-9))


class Spring:
    """Pulls the link that is chosen, as far as its handle is dragged away from it."""

    def __init__(self, page: Stage):
        """No link is chosen yet."""
        self.page, self.link = page, ""
        self.handle: viser.TransformControlsHandle | None = None
        self._pulled = False
        scene = page.server.scene
        self._arrow = scene.add_arrows(
            "/push", np.zeros((1, 2, 3)), COLOR, shaft_radius=0.008, head_radius=0.018
        )
        self._label = scene.add_label("/push_label", "", anchor="bottom-left")
        self._arrow.visible = self._label.visible = False

    def choose(self, link: str) -> None:
        """Put the handle on a link; empty: let go."""
        self.release()
        self.link = link
        if not link:
            return
        self.handle = self.page.server.scene.add_transform_controls(
            "/push_handle",
            scale=0.12,
            disable_rotations=True,
            depth_test=False,
            position=self.page.session.body(link),
        )

        @self.handle.on_update
        def _(_: viser.TransformControlsEvent) -> None:
            self.page.order(self.drag)

    def drag(self) -> None:
        """Pull from now on; the handle stays where it is let go."""
        if self.handle is not None:
            self._pulled = True

    def release(self) -> None:
        """Let go of the link."""
        self._pulled, self.link = False, ""
        self.page.session.push = None
        if self.handle is not None:
            self.handle.remove()
            self.handle = None
        self._arrow.visible = self._label.visible = False

    def tick(self) -> None:
        """Renew the force, and draw it; a handle not yet pulled stays on the link."""
        if self.handle is None:
            return
        link = self.page.session.body(self.link)
        if not self._pulled:
            self.handle.position = link
            return
        force = pull(link, np.array(self.handle.position))
        self.page.session.push = self.link, force
        self._arrow.visible = self._label.visible = True
        self._arrow.points = np.stack([link, self.handle.position])[None].astype("f4")
        self._label.position = self.handle.position
        self._label.text = f"{np.linalg.norm(force):.0f} N"
