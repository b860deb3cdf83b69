"""The pictures of docs/viewer.md: `python -m tests.viewer.pictures`."""

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image

from envs import view
from rmp_mjx import runtime
from rmp_mjx.robot import Robot
from rmp_mjx.viewer.page import Page
from rmp_mjx.viewer.session import Session
from tests.viewer import chromium

FOLDER = Path("docs/img")
SIZE = {"width": 1200, "height": 640}
STEPS = 10
"""Policy steps until the hand is on its way to the handle."""
BESIDE = (0.42, 0.2, 0.45)
"""Where a sphere is dropped: beside the forearm [m]."""


@contextmanager
def opened(page, file: Path) -> Iterator:
    """A page in Chromium; its picture is taken at the end."""
    with chromium.running(page), chromium.browser() as browser:
        window = browser.new_page(viewport=SIZE)
        window.set_default_timeout(chromium.PATIENCE)
        window.goto(page.url)
        chromium.drawn(window)
        window.locator(".mantine-Notification-closeButton").first.click()
        yield window
        with tempfile.TemporaryDirectory() as folder:
            shot = Path(folder) / "shot.png"
            window.screenshot(path=str(shot))
            Image.open(shot).convert("RGB").save(file, quality=82, method=6)


def past_a_sphere(file: Path) -> None:
    """The tree and VICES with the same target and the same sphere."""
    session = Session(Robot.load("jaco2"), ["rmp_vices", "vices"], "sphere")
    session.step()
    page = Page(session, "jaco2", port=8720)
    with opened(page, file) as window:
        window.get_by_role("tab", name="Tree", exact=True).click()
        target = np.array([0.62, 0.02, 0.42]), session.target[1]
        page.order(lambda: setattr(session, "target", target))
        window.wait_for_timeout(4000)
        page.order(page.drive.clock.toggle)
        window.wait_for_timeout(3000)


def at_the_door(file: Path) -> None:
    """What the tree thinks where a policy opens the door."""
    flags = ["--run", "pretrained/door-rmp_vices", "--deterministic"]
    page = view.page(flags, 8721, Path("runs/viewer"))
    page.play.put(0, BESIDE)
    for _ in range(STEPS):
        page.play.step()
    page.player.paused = True
    with opened(page, file) as window:
        window.get_by_text("What the tree thinks").click()
        for name in ("Control points by weight", "The gap", "Pulls of the leaves"):
            window.get_by_role("checkbox", name=name, exact=True).click()
        chromium.wait(lambda: "asks" in page.tree.bars.content, "a thought")
        window.get_by_text("Eigenvalues").scroll_into_view_if_needed()
        window.mouse.move(400.0, 320.0)
        window.mouse.wheel(0.0, -400.0)  # nearer
        window.wait_for_timeout(3000)


def main() -> int:
    """Take them; returns the exit code."""
    if why := chromium.missing():
        sys.stderr.write(f"error: {why}\n")
        return 2
    runtime.configure()
    past_a_sphere(FOLDER / "viewer.webp")
    at_the_door(FOLDER / "viewer_door.webp")
    return 0


if __name__ == "__main__":
    sys.exit(main())
