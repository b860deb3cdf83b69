"""The last seconds as an MP4."""

import collections
from types import SimpleNamespace
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest

from rmp_mjx import runtime
from rmp_mjx.viewer import film
from rmp_mjx.viewer.page import Page


def simulation(period, frames) -> Any:
    return SimpleNamespace(period=period, history=collections.deque(range(frames)))


def test_a_film_has_the_last_seconds_and_the_newest_frame():
    frames, fps = film.sampled(simulation(0.005, 6000))
    assert frames[-1] == 5999 and fps == pytest.approx(25.0)
    assert np.all(np.diff(frames) == 8) and len(frames) == 250  # ten seconds
    frames, fps = film.sampled(simulation(0.05, 7))  # a slow one has every frame
    assert frames == list(range(7)) and fps == pytest.approx(20.0)


def test_the_camera_is_where_the_page_begins():
    eye, middle = np.array([1.0, -1.0, 1.0]), np.array([0.2, 0.1, 0.4])
    seen = film.camera(eye, middle)
    a, e = np.deg2rad([seen.azimuth, seen.elevation])
    ahead = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    np.testing.assert_allclose(seen.lookat - seen.distance * ahead, eye, atol=1e-12)


def test_no_film_is_made_before_something_was_shown(tmp_path):
    with pytest.raises(ValueError, match="nothing was shown yet"):
        film.make(simulation(0.05, 0), lambda frames: [], tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_machine_that_cannot_draw_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(runtime, "choose_gl", lambda: None)
    with pytest.raises(ValueError, match="neither EGL nor OSMesa"):
        film.make(simulation(0.05, 3), lambda frames: [], tmp_path)


@pytest.mark.skipif(runtime.choose_gl() is None, reason="no headless rendering here")
def test_the_button_films_the_arm_that_moved(session, tmp_path):
    session.start(["rmp_vices", "vices"])
    session.target = session.target[0] + [0.0, 0.25, 0.0], session.target[1]
    page = Page(session, "jaco2", port=8730, folder=tmp_path)
    for _ in range(200):
        session.step()
    page.drive.clock.make_film().join(120.0)
    page._obey()
    page.server.stop()
    (path,) = tmp_path.glob("*.mp4")
    assert str(path) in page.drive.clock.saved.content
    reader = imageio_ffmpeg.read_frames(path)
    about = next(reader)
    assert about["size"] == film.SIZE[::-1]
    assert about["fps"] == pytest.approx(film.RATE)
    width, height = about["size"]
    pictures = [np.frombuffer(x, np.uint8).reshape(height, width, 3) for x in reader]
    assert len(pictures) == 25  # 200 steps of 5 ms
    first, last = (np.asarray(pictures[k], float) for k in (0, -1))
    assert first.std() > 5.0  # there is something to see
    assert (np.abs(last - first).max(axis=2) > 30.0).mean() > 0.005  # and it moved
