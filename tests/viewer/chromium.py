"""Debian's Chromium without a screen, for the tests and the pictures of the viewer."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

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
