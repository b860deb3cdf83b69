"""Pictures of recorded episodes, drawn by a stand-in for the renderer."""

import io

import imageio_ffmpeg
import mediapy
import numpy as np
import pytest
from rich.console import Console

from rmp_mjx import runtime
from rmp_mjx.training.evaluation import film
from rmp_mjx.training.evaluation.recording import Recording

LENGTHS = np.array([2, 5, 3])


@pytest.fixture
def tape():
    """Three episodes; the state is ten times the episode plus the step."""
    steps = np.minimum(np.arange(6)[:, None], LENGTHS)
    return Recording(10 * np.arange(3) + steps, LENGTHS)


def draw(states, size, shadows):
    """Frames of one grey value, the state's."""
    return [np.full((*size, 3), state, np.uint8) for state in states]


def test_a_storyboard_is_stills_from_start_to_end_in_a_row():
    tape = Recording(np.arange(41)[:, None], np.array([40]))
    height, width = film.SMALL
    picture = film.storyboard(draw, tape)
    assert picture.shape == (height, 6 * width, 3)
    np.testing.assert_array_equal(picture[0, ::width, 0], [0, 8, 16, 24, 32, 40])


def test_in_the_grid_an_ended_episode_keeps_its_last_frame(tape):
    frames = film.grid(draw, tape)
    height, width = film.SMALL
    assert len(frames) == 4  # every second step and the last one: 0, 2, 4, 5
    assert all(frame.shape == (2 * height, 2 * width, 3) for frame in frames)
    tiles = [f[::height, ::width, 0].ravel().tolist() for f in frames]
    assert tiles[0] == [0, 10, 20, 0]  # the fourth tile is empty
    assert tiles[1] == [2, 12, 22, 0]
    assert tiles[2] == [2, 14, 23, 0]
    assert tiles[3] == [2, 15, 23, 0]


def publish(tape, folder, draw):
    text = io.StringIO()
    film.publish(draw, tape, 0.05, folder, Console(file=text, width=200))
    return text.getvalue()


def test_pictures_are_written_where_rendering_works(tape, tmp_path, monkeypatch):
    monkeypatch.setattr(runtime, "choose_gl", lambda: "egl")
    assert publish(tape, tmp_path, draw) == ""
    assert mediapy.read_image(tmp_path / "instance.png").shape == (480, 640, 3)
    assert (tmp_path / "storyboard.png").exists()
    about, *frames = imageio_ffmpeg.read_frames(str(tmp_path / "video.mp4"))
    assert about["size"] == (640, 480) and about["fps"] == 10.0
    assert len(frames) == 4


@pytest.mark.parametrize("gl", [None, "egl"])
def test_without_rendering_one_line_says_so(tape, tmp_path, monkeypatch, gl):
    def broken(states, size, shadows):
        raise RuntimeError("no\ncontext")

    monkeypatch.setattr(runtime, "choose_gl", lambda: gl)
    said = publish(tape, tmp_path, broken)
    assert said.count("\n") == 1
    assert said.startswith("no pictures: ")
