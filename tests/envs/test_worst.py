"""The worst episodes of an evaluation: kept as they were, and opened again."""

import json
from typing import Any

import jax
import numpy as np
import pytest

from envs import worst
from rmp_mjx.training.learning.networks import random_agent
from rmp_mjx.viewer.__main__ import main

EPISODES, SEED = 12, 5


@pytest.fixture(scope="module")
def task(make):
    """Random torques among two spheres: some episodes hit something, some do not."""
    return make("torques", episode_length=24)


@pytest.fixture(scope="module")
def evaluated(task, tmp_path_factory):
    """An evaluation, and the folder that it left."""
    agent, key = random_agent(task.env.action_size), jax.random.key(SEED)
    results, tape = worst.recorder(task.env, EPISODES, False)(agent, key)
    folder = tmp_path_factory.mktemp("run")
    (folder / "worst").mkdir()
    (folder / "worst" / "99999.npz").write_text("of an earlier evaluation")
    return results, tape, worst.save(task.env, tape, results, folder), folder


def test_the_nearest_and_the_eventful_episodes_are_kept(task, evaluated):
    results, _, cases, folder = evaluated
    hit = set(np.flatnonzero(results["collision"] > 0).tolist())
    assert 0 < len(hit) < EPISODES
    nearest = np.argsort(results["clearance"], kind="stable")[: worst.NEAREST]
    kept = {case.episode for case in cases}
    assert kept >= hit | set(nearest.tolist())
    for case in cases:
        assert ("collision" in case.moments) == (case.episode in hit)
    index = json.loads((folder / "worst" / "index.json").read_text())
    assert (index["episodes"], index["searched"]) == (EPISODES, EPISODES)
    named = {line["file"] for line in index["kept"]}
    assert named == {path.name for path in (folder / "worst").glob("*.npz")}
    clearances = [line["clearance"] for line in index["kept"]]
    assert clearances == sorted(clearances)


def test_the_actions_of_a_kept_episode_lead_to_the_same_event(make, evaluated):
    task = make("torques")  # what other tests compile; its time limit is another
    _, _, cases, folder = evaluated
    case = next(case for case in cases if "collision" in case.moments)
    kept = worst.load(folder / "worst" / f"{case.episode:05d}.npz", task.env)
    # evaluate.play: starts come from the first half of the key
    starts = jax.random.split(jax.random.split(jax.random.key(SEED))[0], EPISODES)
    own = np.full(8, case.episode)  # the eight lanes that other tests compile
    state = task.reset(starts[own])
    t = -1
    for t, then in enumerate(kept.states[1:]):
        action = kept.states[t].info["action"]
        state = task.step(state, np.tile(action, (8, 1)))
        # other programs round differently: 0.1 mrad before the first contact
        if t < case.moments["collision"] - 1:
            q = np.asarray(state.data.qpos[0])
            np.testing.assert_allclose(q, then.data.qpos, atol=1e-4)
        if float(state.metrics["collision"][0]):
            break
    assert t + 1 == case.moments["collision"]


def test_a_film_needs_no_more_than_what_is_kept(evaluated):
    tape = evaluated[1].first(9)
    assert tape.count == 9 and tape.state(0, 0).data.sensors.size == 0


def test_an_arm_that_does_not_move_stalls_unless_the_task_is_solved():
    q = np.concatenate([np.linspace(0.0, 1.0, 20), np.ones(31)])[:, None]
    free = np.zeros(50, bool)
    assert worst.stalled(q, free, 10) == 19
    assert worst.stalled(q[:25], free[:24], 10) is None
    assert worst.stalled(q[:5], free[:4], 10) is None
    solved = free.copy()
    solved[19:] = True
    assert worst.stalled(q, solved, 10) is None


def _shown(page: Any) -> Any:
    return page.player.shown


def test_an_episode_opens_at_the_moment_it_happened(task, evaluated, tmp_path):
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    from envs.episode_page import EpisodePage

    folder = evaluated[3] / "worst"
    files = [folder / f"{case.episode:05d}.npz" for case in evaluated[2]]
    case = next(case for case in evaluated[2] if "collision" in case.moments)
    page = EpisodePage([folder / f"{case.episode:05d}.npz", *files], 8770, tmp_path)
    try:
        page.tick(0.05)
        shown = _shown(page)
        assert page.player.paused and shown.steps == case.opened
        assert shown.events.get("collision") == 1
        assert "collision" in page.happened.content
        page.player.once()
        length = len(page.kept.states) - 1
        assert _shown(page).steps == min(case.opened + 1, length)
        page.start_over()
        page.tick(0.05)
        assert _shown(page).steps == 1
        page.player.go_on_from_there()
        assert len(page.player.simulation.history) == 2
        other = next(c for c in evaluated[2] if c.episode != case.episode)
        label = next(n for n in page.which.options if n.startswith(f"{other.episode}:"))
        page.which.value = label
        page._choose()
        assert _shown(page).episode == other.episode
    finally:
        page.server.stop()


def test_files_that_are_no_episodes_are_refused(tmp_path, capsys, evaluated, task):
    (tmp_path / "a.npz").write_bytes(b"nothing")
    assert main(["--episode", str(tmp_path / "a.npz")]) == 2
    assert "no episode of an evaluation" in capsys.readouterr().err
    assert main(["--run", str(tmp_path), "--worst"]) == 2
    assert "no worst episodes" in capsys.readouterr().err
    assert main(["--worst"]) == 2
    assert "--run" in capsys.readouterr().err
    file = next((evaluated[3] / "worst").glob("*.npz"))
    with np.load(file) as stored:
        arrays = {name: stored[name] for name in stored.files}
    arrays[".data.qpos"] = arrays[".data.qpos"][:, :5]
    np.savez(tmp_path / "b.npz", **arrays)
    with pytest.raises(ValueError, match="another task: "):
        worst.load(tmp_path / "b.npz", task.env)
