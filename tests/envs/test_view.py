"""A policy at work in its task, as the viewer plays it."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
from rich.console import Console

pytest.importorskip("viser", reason="the extra viewer is not installed")

from envs import play as playing
from envs import view, watch
from envs.cli import make_config
from envs.thoughts import thinker
from envs.train import main as train
from rmp_mjx import runtime
from rmp_mjx.training.learning.networks import zero_agent
from rmp_mjx.viewer.__main__ import main
from tests.viewer.chromium import wait


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
        if runtime.choose_gl() is not None:  # else no film can be made
            (picture,) = page.render([play.now])
            assert picture.shape == (480, 640, 3) and picture.std() > 5.0
    finally:
        page.server.stop()


def test_what_the_tree_thinks_is_shown_where_users_want_it(play, tmp_path):
    page = view.PolicyPage(play, "a task", 8735, tmp_path)
    try:
        page.tick(play.env.dt)
        thoughts = page.tree.thoughts
        assert not thoughts.wanted and not thoughts.gap.visible
        assert page.tree.bars.content == "" and thoughts.arrows is None
        thoughts.show_gap = thoughts.show_pulls = True
        page.tick(play.env.dt)
        assert thoughts.gap.visible
        assert thoughts.arrows is not None and thoughts.arrows.visible
        assert "collision: asks" in page.tree.bars.content
        # The gap is the task's clearance, which the environment measures in its way.
        clearance = float(play.now.state.metrics["clearance"])
        assert thoughts.label.text == f"{1e3 * clearance:.0f} mm"
        thoughts.show_gap = thoughts.show_pulls = False
        page.tick(0.0)
        assert not thoughts.gap.visible and not thoughts.arrows.visible
    finally:
        page.server.stop()


def test_the_tree_thinks_of_the_action_that_is_taken(play):
    play.begin()
    now = play.step()
    env, think = play.env, thinker(play.env)
    q = now.state.data.qpos[: env.robot.n]
    action = play.intent(now)
    assert think is not None
    insight = think(now.state, action)
    setpoint = env.controller.setpoint(
        q, env.controller.decode(action), env.dt * now.state.info["step"]
    )
    # The branch of position asks for the impedance's acceleration: M^-1 f at the hand.
    site = env.site(now.state.data)
    ahead = np.asarray(setpoint.p_des - site.p)
    pull = np.asarray(insight.pull["position"])
    wanted = np.asarray(setpoint.kp_pos) * ahead
    assert pull @ wanted > 0.0
    assert np.allclose(
        play.step().state.data.qpos, env.step(now.state, action).data.qpos
    )


def test_a_controller_without_a_pose_as_target_has_no_tree():
    other: Any = SimpleNamespace(controller=len, robot=SimpleNamespace(n=7))
    assert thinker(other) is None


@pytest.fixture
def watched(play, tmp_path, monkeypatch):
    """The page of a training whose folder the test fills; checkpoints are feigned."""
    agent = zero_agent(play.env.action_size)
    monkeypatch.setattr(
        watch.policies, "load_agent", lambda env, config, run, *_: (7, agent)
    )
    run, before = tmp_path / "run", play.agent
    run.mkdir()
    page = watch.WatchPage(play, make_config(), run, 8740, tmp_path)
    yield page
    page.server.stop()
    play.agent = before


def test_a_training_is_followed_by_its_curves_and_its_newest_policy(watched, play):
    watched.look()
    assert not watched.charts and watched.iterations == 0
    rows = {"steps": [10, 20, 30], "episode/return": [None, 1.0, 2.0], "seed": [0] * 3}
    file = watched.run_folder / "metrics.parquet"
    pl.DataFrame(rows).write_parquet(file)
    (watched.run_folder / "checkpoints" / "7").mkdir(parents=True)
    (watched.run_folder / "checkpoints" / "8.tmp").mkdir()
    watched.look()
    assert set(watched.charts) == {"episode/return"}
    watched._loading.join(60.0)
    watched._obey()
    assert watched.iterations == 7 and "iteration 7" in watched.policy.content
    assert np.array_equal(watched.charts["episode/return"].data[0], [10, 20, 30])
    more = {name: [*values, values[-1]] for name, values in rows.items()}
    pl.DataFrame(more).write_parquet(file)
    os.utime(file, (2e9, 2e9))  # newer, whatever the clock's resolution
    watched.look()
    assert len(watched.charts["episode/return"].data[0]) == 4


def test_a_page_that_nobody_looks_at_costs_its_training_nothing(watched, play):
    before = play.now
    watched.tick(1.0)
    assert play.now is before
    watched.watched = lambda: True
    watched.tick(1.0)
    assert play.now is not before


def test_the_page_of_a_training_ends_with_it_and_does_it_no_harm(tmp_path):
    console = Console(quiet=True)
    with watch.watching(tmp_path, make_config(), console) as page:
        assert page.poll() is None
    assert page.returncode is not None
    with watch.watching(tmp_path, make_config(), console) as page:
        page.kill()


def test_a_killed_training_takes_its_page_along(tmp_path, root):
    lines = (
        "import sys, time, pathlib, rich.console",
        "from envs import watch, cli",
        "run, console = pathlib.Path(sys.argv[1]), rich.console.Console(quiet=True)",
        "with watch.watching(run, cli.make_config(), console) as page:",
        "    print(page.pid, flush=True)",
        "    time.sleep(300)",
    )
    command = [sys.executable, "-c", "\n".join(lines), str(tmp_path)]
    training = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=root)
    assert training.stdout is not None
    page = Path("/proc") / training.stdout.readline().strip()
    assert page.exists()
    training.kill()
    training.wait()
    # its imports, at the lowest priority, on a busy machine
    wait(lambda: not page.exists() or _ended(page), "the end of the page", 120.0)


def _ended(process: Path) -> bool:
    """Whether a process has ended, and only its parent has not noticed."""
    try:
        return process.joinpath("stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def test_a_live_view_of_a_grid_is_refused(capsys):
    assert train(["--envs", "push,door", "--watch"]) == 2
    assert "--watch shows one run" in capsys.readouterr().err
    assert main(["--watch"]) == 2
    assert "need --run" in capsys.readouterr().err


def test_a_run_that_is_none_is_refused(capsys):
    assert main(["--run", "no/such/run"]) == 2
    assert "no/such/run" in capsys.readouterr().err
    assert main(["--sceen", "free"]) == 2
    assert "--sceen" in capsys.readouterr().err
