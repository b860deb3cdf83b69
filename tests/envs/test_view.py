"""A policy at work in its task, as the viewer plays it."""

import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra viewer is not installed")

from envs import view
from rmp_mjx.viewer.__main__ import main


@pytest.fixture(scope="module")
def play():
    flags = ["--run", "pretrained/trajectory-rmp_vices", "--deterministic"]
    return view.load([*flags, "--episode_length", "4"])[0]


def test_episodes_follow_each_other_and_dropped_spheres_stay(play):
    place = np.array([0.9, 0.9, 0.3])
    play.begin()
    first = play.episode
    assert play.dropped == {}
    play.put(1, place)
    states = [play.step() for _ in range(5)]
    assert play.episode == first + 1 and int(states[-1].info["step"]) == 1
    assert list(play.dropped) == [1]
    assert np.allclose(play.dropped[1], place)  # spheres by hand do not move
    assert len(play.history) == 5
    play.put(1, None)
    assert play.dropped == {}


def test_a_sphere_dropped_onto_the_hand_is_a_collision(play):
    play.begin()
    play.put(0, np.asarray(play.env.site(play.state.data).p))
    play.step()
    assert play.events.get("collision") == 1


def test_the_page_draws_the_task_and_takes_orders(play, tmp_path):
    page = view.TaskPage(play, "a task", 8730, tmp_path)
    try:
        for _ in range(view.BY_HAND):
            page.drop()
        assert sorted(play.dropped) == [0, 1, 2]
        with pytest.raises(ValueError, match="at most 3"):
            page.drop()
        page.tick(play.env.dt)
        assert "episode" in page.status.content
        page.clear()
        assert play.dropped == {}
    finally:
        page.server.stop()


def test_a_run_that_is_none_is_refused(capsys):
    assert main(["--run", "no/such/run"]) == 2
    assert "no/such/run" in capsys.readouterr().err
    assert main(["--sceen", "free"]) == 2
    assert "--sceen" in capsys.readouterr().err
