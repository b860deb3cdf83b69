"""A policy at work in its task, as the viewer plays it."""

import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra viewer is not installed")

from envs import play as playing
from envs import view
from rmp_mjx.viewer.__main__ import main


@pytest.fixture(scope="module")
def play():
    flags = ["--run", "pretrained/trajectory-rmp_vices", "--deterministic"]
    return playing.load([*flags, "--episode_length", "4"])[0]


def test_episodes_follow_each_other_and_dropped_spheres_stay(play):
    place = np.array([0.9, 0.9, 0.3])
    play.begin()
    first = play.now.episode
    assert play.dropped == {}
    play.put(1, place)
    moments = [play.step() for _ in range(5)]
    assert [moment.episode - first for moment in moments] == [0, 0, 0, 0, 1]
    assert int(moments[-1].state.info["step"]) == 1
    assert list(play.dropped) == [1]
    assert np.allclose(play.dropped[1], place)  # spheres by hand do not move
    assert len(play.history) == 5
    play.put(1, None)
    assert play.dropped == {}


def test_an_episode_goes_on_from_an_earlier_moment_as_before(play):
    play.begin()
    first, second, third = (play.step() for _ in range(3))
    play.restore(first)
    assert play.history[-1] is first
    again = play.step()
    assert again.steps == second.steps and again.reward == second.reward
    assert np.array_equal(play.step().state.data.qpos, third.state.data.qpos)


def test_a_sphere_dropped_onto_the_hand_is_a_collision(play):
    play.begin()
    play.put(0, np.asarray(play.env.site(play.now.state.data).p))
    play.step()
    assert play.now.events.get("collision") == 1


def test_the_page_draws_the_task_and_takes_orders(play, tmp_path):
    page = view.PolicyPage(play, "a task", 8730, tmp_path)
    try:
        for _ in range(playing.BY_HAND):
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
