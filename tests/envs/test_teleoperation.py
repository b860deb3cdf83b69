"""A person at the target, without a browser: actions, demonstrations, their file."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra viewer is not installed")

from envs import teleoperate, teleoperation
from envs.teleoperation import Wish
from rmp_mjx.control.action import ActionRange, WeightedActionRange
from rmp_mjx.math import quat_to_mat
from rmp_mjx.training import demonstrations
from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.learning import cloning
from rmp_mjx.training.learning.networks import make_agent
from rmp_mjx.training.learning.ppo import make_ppo
from rmp_mjx.viewer.__main__ import main
from tests.training import toys
from tests.viewer import chromium

SPAN, LEVEL = ActionRange(), np.array([1.0, 0.0, 0.0, 0.0])
UP = np.array([0.0, 0.0, 1.0])
SIZES = ("observation_size", "action_size")


PAD = """
window.pad = {connected: true, axes: [0, 0, 0, 0], buttons: []};
for (let k = 0; k < 17; k++) window.pad.buttons.push({pressed: false});
navigator.getGamepads = () => [null, window.pad];
"""
"""A gamepad for the browser, since this machine may have none."""


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demos") / "new"
    return teleoperation.load("trajectory", ["--controller", "osc"], folder)


def test_an_action_is_the_way_to_the_wish_within_the_range():
    p, R = jnp.array([0.1, 0.2, 0.3]), jnp.eye(3)
    near = Wish(np.array([0.125, 0.2, 0.3]), LEVEL, 300.0)
    action = teleoperation.action_towards(SPAN, p, R, near)
    # float32: positions of 0.3 m have 3e-8 m, a millionth of the range
    assert np.allclose(action, [0.5, *[0.0] * 5, *[1.0] * 6], atol=1e-5)
    far = near._replace(position=np.array([1.1, 0.7, 0.3]), kp=10.0)
    action = teleoperation.action_towards(SPAN, p, R, far)
    assert np.allclose(action, [1.0, 0.5, *[0.0] * 4, *[-1.0] * 6], atol=1e-5)
    weighted = WeightedActionRange()
    action = teleoperation.action_towards(weighted, p, R, near)
    assert action.shape == (weighted.size,) and not action[12:].any()


def test_the_hand_follows_the_wish(driven):
    driven.begin()
    start = driven.wish.position
    driven.wish = driven.wish._replace(position=start + 0.05 * UP, kp=300.0)
    for _ in range(5):
        driven.step()
    moved = driven.here(100.0).position - start
    assert moved[2] > 0.03  # in a quarter of a second most of the 5 cm
    assert np.abs(moved[:2]).max() < 0.01


def test_whole_episodes_become_demonstrations_that_train_a_clone(driven, monkeypatch):
    monkeypatch.setattr(cloning, "STEPS", 1000)
    monkeypatch.setattr(type(driven.env), "episode_length", 6)
    with pytest.raises(ValueError, match="press Record first"):
        driven.keep()
    driven.record()
    last = driven.now
    for _ in range(8):  # two more than the episode has
        driven.wish = driven.wish._replace(position=driven.wish.position + 0.002)
        last = driven.step()
    assert driven.over and driven.length == 6
    assert "keep or discard" in teleoperate.said(driven)
    driven.keep()
    assert not driven.recording and driven.now.episode == last.episode + 1
    driven.record()
    frames = [driven.step() for _ in range(4)]
    driven.restore(frames[1])
    assert driven.length == 2  # what came later is forgotten
    driven.step()
    driven.keep()
    driven.record()
    driven.step()
    driven.discard()
    found = demonstrations.read(driven.path)
    found.check(driven.env)
    assert found.episode.tolist() == [0] * 6 + [1] * 3
    assert found.step.tolist() == [*range(6), *range(3)]
    assert found.about["source"] == "teleoperation"
    assert found.about["task"]["env"] == "trajectory"
    assert found.about["action"][:2] == ["dpos_x", "dpos_y"]

    size = {name: getattr(driven.env, name) for name in SIZES}
    config = PPOConfig(num_envs=1, unroll_length=8, hidden_sizes=(16,))
    ppo = make_ppo(toys.ConstantReward(**size), config)
    state = jax.jit(ppo.init)(jax.random.key(0))
    cloned = jax.jit(partial(cloning.clone, ppo))(
        state, found.observation, found.action
    )
    before, after = (
        make_agent(ppo.networks, s.normalizer, s.learner.policy, True)(
            jnp.asarray(found.observation), jax.random.key(0)
        )
        for s in (state, cloned)
    )
    missed = np.abs(after - found.action).mean()
    assert missed < 0.1 * np.abs(before - found.action).mean()  # nine rows, by heart


def test_the_page_has_a_target_keys_and_buttons(driven, tmp_path):
    page = teleoperate.DrivePage(driven, "a task", 8760, tmp_path)
    try:
        page.tick(driven.env.dt)
        start = np.array(page.target.position)
        assert np.allclose(start, driven.wish.position)
        page.nudge(2, 0.02)
        assert np.allclose(driven.wish.position, start + 0.02 * UP)
        page.kp.value = 200.0
        page.nudge(0, 0.0)
        assert driven.wish.kp == 200.0
        page.stiffen(1.25)
        assert driven.wish.kp == 250.0
        page.stiffen(1e3)
        assert driven.wish.kp == driven.stiffnesses[1]
        before = np.array(page.target.wxyz)
        page.turn(2, np.pi / 2)  # about the world's axis, not the target's
        x, y = (quat_to_mat(jnp.asarray(w)) for w in (before, page.target.wxyz))
        quarter = jnp.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        assert np.allclose(y, quarter @ x, atol=1e-6)  # float32
        assert np.allclose(driven.wish.wxyz, page.target.wxyz)
        driven.record()
        page.tick(driven.env.dt)
        assert "recording" in page.told.content
        assert np.allclose(page.target.position, driven.wish.position)  # a new episode
        driven.discard()
        page.tick(driven.env.dt)
        assert "not recording" in page.told.content
    finally:
        page.server.stop()


@pytest.mark.skipif(bool(chromium.missing()), reason=chromium.missing())
def test_keys_and_a_gamepad_drive_the_hand_in_a_browser(driven, tmp_path):
    driven.begin()
    driven.step()  # compiled before the clock runs
    page = teleoperate.DrivePage(driven, "a task", 8765, tmp_path)
    kept = len(driven.kept)
    with chromium.browser() as browser, chromium.running(page):
        tab = chromium.Tab(browser, page, PAD)
        place, turned = np.array(page.target.position), np.array(page.target.wxyz)
        tab.window.keyboard.press("u")
        chromium.wait(lambda: page.target.position[2] > place[2] + 0.019, "a stroke")
        tab.window.keyboard.press("Shift+J")
        chromium.wait(lambda: not np.allclose(page.target.wxyz, turned), "a turn")

        tab.window.evaluate("pad.buttons[0].pressed = true")
        chromium.wait(lambda: driven.recording, "a recording")
        start = driven.wish.position
        tab.window.evaluate("pad.axes[0] = -1.0")
        chromium.wait(lambda: driven.wish.position[1] > start[1] + 0.09, "a way left")
        tab.window.evaluate("pad.axes[0] = 0.05")  # at rest, nearly
        followed = driven.wish.position
        chromium.wait(
            lambda: bool(np.abs(driven.here(100.0).position - followed).max() < 0.02),
            "the hand follows",
        )
        assert np.array_equal(driven.wish.position, followed)
        tab.window.evaluate("pad.buttons[2].pressed = true")
        chromium.wait(lambda: len(driven.kept) > kept, "a demonstration")

        tab.window.get_by_text("What the tree thinks").click()
        tab.click("Pulls of the leaves", "checkbox")
        shown = page.tree.thoughts
        chromium.wait(lambda: bool(shown.arrows and shown.arrows.visible), "arrows")
        chromium.wait(lambda: "posture" in page.tree.bars.content, "bars")
        assert tab.faults == []
    found = demonstrations.read(driven.path)
    # on the way all went to the left: -1 to 1 of the action's y
    assert found.action[found.episode == kept][:, 1].max() > 0.5


def test_a_task_that_is_none_is_refused(capsys):
    assert main(["--teleoperate", "nowhere"]) == 2
    assert "nowhere" in capsys.readouterr().err
