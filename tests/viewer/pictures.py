"""The picture of docs/viewer.md: `python -m tests.viewer.pictures`."""

import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from rmp_mjx import runtime
from rmp_mjx.robot import Robot
from rmp_mjx.viewer.page import Page
from rmp_mjx.viewer.session import Session
from tests.viewer import chromium

FILE = Path("docs/img/viewer.webp")


def main() -> int:
    """Take it in Chromium; returns the exit code."""
    if why := chromium.missing():
        sys.stderr.write(f"error: {why}\n")
        return 2
    runtime.configure()
    session = Session(Robot.load("jaco2"), ["rmp_vices", "vices"], "sphere")
    session.step()
    page = Page(session, "jaco2", port=8720)
    with chromium.running(page), chromium.browser() as browser:
        window = browser.new_page(viewport={"width": 1200, "height": 640})
        window.goto(page.url)
        chromium.drawn(window)
        window.locator(".mantine-Notification-closeButton").first.click()
        window.get_by_role("tab", name="Tree", exact=True).click()
        target = np.array([0.62, 0.02, 0.42]), session.target[1]
        page.order(lambda: setattr(session, "target", target))
        window.wait_for_timeout(4000)
        page.order(page.drive.clock.toggle)
        window.wait_for_timeout(3000)
        with tempfile.TemporaryDirectory() as folder:
            shot = Path(folder) / "shot.png"
            window.screenshot(path=str(shot))
            Image.open(shot).convert("RGB").save(FILE, quality=82, method=6)
    return 0


if __name__ == "__main__":
    sys.exit(main())
