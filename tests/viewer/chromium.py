"""Debian's Chromium without a screen, for the tests and the pictures of the viewer."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import imageio.v3
import numpy as np

PATH = Path("/usr/bin/chromium")
ARGUMENTS = [
    "--headless",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
SIZE = {"width": 1000, "height": 600}
HARMLESS = ("THREE.Clock", "GPU stall", "GL Driver Message")
"""Warnings of the browser's own libraries."""
PATIENCE = 120_000
"""Milliseconds: a second tab has taken half a minute on two busy cores."""


def missing() -> str:
    """Why there is no browser here; empty if there is one."""
    try:
        import playwright.sync_api  # noqa: F401
    except ImportError as error:
        return f"no Playwright: {error}"
    return "" if PATH.exists() else f"no Chromium at {PATH}"


@contextlib.contextmanager
def browser() -> Iterator:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=str(PATH), args=ARGUMENTS)
        yield chromium
        chromium.close()


@contextlib.contextmanager
def running(page) -> Iterator:
    """A page whose loop runs in a thread."""
    loop = threading.Thread(target=page.run, daemon=True)
    loop.start()
    yield page
    page.stop()
    loop.join(20.0)


def drawn(window) -> None:
    """Wait for the scene: one of the page's canvases has a size."""
    sized = "[...document.querySelectorAll('canvas')].some(canvas => canvas.width > 0)"
    window.wait_for_function(sized, timeout=PATIENCE)


def wait(condition: Callable[[], bool], what: str, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"not within {seconds} s: {what}"
        time.sleep(0.05)


def pixels(client, point) -> np.ndarray:
    """Where a point of the world is in a client's window."""
    camera = client.camera
    w, x, y, z = camera.wxyz
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    right, down, ahead = R.T @ (np.asarray(point) - camera.position)
    height = SIZE["height"]
    focal = 0.5 * height / np.tan(0.5 * camera.fov)
    center = np.array([SIZE["width"], height]) / 2
    return center + focal * np.array([right, down]) / ahead


class Tab:
    """A tab of the browser with the page in it."""

    def __init__(self, browser, page, script=""):
        self.page, self.faults = page, []
        known = set(page.server.get_clients())
        self.window = browser.new_page(viewport=SIZE)
        self.window.set_default_timeout(PATIENCE)
        self.window.add_init_script(script)
        self.window.on("console", self._heard)
        self.closed = 0
        self.window.on("websocket", lambda socket: socket.on("close", self._closed))
        self.window.on("pageerror", lambda error: self.faults.append(str(error)))
        self.window.goto(page.url)
        drawn(self.window)
        self.client = self.joined(known)

    def joined(self, known):
        clients = self.page.server.get_clients
        wait(lambda: set(clients()) > known or len(clients()) == 1, "a client")
        return clients()[max(clients())]

    def _closed(self, _):
        self.closed += 1

    def _heard(self, message):
        bad = message.type in ("error", "warning")
        if bad and not any(word in message.text for word in HARMLESS):
            self.faults.append(message.text)

    def picture(self):
        """The scene without the panel, as numbers."""
        shot = self.window.screenshot(
            clip={"x": 320, "y": 150, "width": 330, "height": 440}
        )
        return np.asarray(imageio.v3.imread(shot)[..., :3], float)

    def click(self, name, role="button"):
        self.window.get_by_role(role, name=name, exact=True).first.click()

    def press(self, name):
        """Click a button, but without the mouse: it waits for two pictures alike."""
        found = self.window.get_by_role("button", name=name, exact=True).first
        found.dispatch_event("click")

    def choose(self, label, option):
        self.window.get_by_label(label, exact=True).first.click()
        self.window.get_by_role("option", name=option, exact=True).first.click()

    def drag(self, point, axis, distance):
        """Drag a gizmo's arrow, whose tip is 15 cm from its middle."""
        self.window.bring_to_front()
        start = pixels(self.client, point + 0.155 * axis)
        end = pixels(self.client, point + (0.155 + distance) * axis)
        mouse = self.window.mouse
        mouse.move(*(start - 2))
        self.window.wait_for_timeout(300)
        mouse.move(*start)
        self.window.wait_for_timeout(800)  # software WebGL has few frames a second
        mouse.down()
        for share in (0.3, 0.7, 1.0):
            mouse.move(*(start + share * (end - start)))
            self.window.wait_for_timeout(250)
        mouse.up()
