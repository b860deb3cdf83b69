"""Evaluation: one episode per environment, exact, reproducible."""

import jax
import numpy as np
import pytest

from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.evaluation import evaluate, recording
from rmp_mjx.training.learning.networks import random_agent, zero_agent
from rmp_mjx.training.runs.policies import load_agent
from rmp_mjx.training.stats import bootstrap_mean, clopper_pearson, mean_sd
from tests.training import toys

EPISODES = 12
KEY = jax.random.key(3)


@pytest.fixture(scope="module")
def results():
    env = toys.Counter()
    return evaluate.run_episodes(env, random_agent(1), EPISODES, KEY)


def test_every_environment_runs_exactly_one_episode(results):
    env = toys.Counter()
    starts = jax.vmap(env.reset)(
        jax.random.split(jax.random.split(KEY)[0], EPISODES)
    ).obs
    lengths = np.asarray(starts[:, 0])
    reached = lengths <= env.episode_length
    assert 0 < reached.sum() < EPISODES
    np.testing.assert_array_equal(
        results["length"], np.minimum(lengths, env.episode_length)
    )
    np.testing.assert_array_equal(results["return"], -1.0 * reached)
    np.testing.assert_array_equal(results["collision"], reached)
    np.testing.assert_allclose(results["clearance"], 0.1 - reached, atol=1e-7)
    assert not results["lost"].any()


def test_few_lanes_work_through_many_episodes(results, recorded, monkeypatch):
    """Each as if it had a lane of its own: values, ends and recordings."""
    monkeypatch.setattr(evaluate, "LANES", 3)
    again, tape = evaluate.record_episodes(
        toys.Counter(), zero_agent(1), EPISODES, KEY, recorded=4
    )
    for name in set(results) - {"effort"}:  # the agents differ in that alone
        np.testing.assert_array_equal(again[name], results[name])
    np.testing.assert_array_equal(tape.lengths, recorded[1].lengths)
    for episode, length in enumerate(tape.lengths):
        seen = [float(tape.state(episode, t).obs[1]) for t in range(length + 1)]
        assert seen == list(range(length + 1))


def test_a_recording_keeps_what_it_is_told_and_changes_no_number(results):
    def keep(state, action):
        return {"seen": state.obs, "action": action}

    agent, most = random_agent(1), 3
    record = evaluate.recorder(toys.Counter(), EPISODES, EPISODES, keep, most)
    again, tape = record(agent, KEY)
    for name, values in results.items():
        np.testing.assert_array_equal(again[name], values)
    assert set(tape.states) == {"seen", "action"}
    np.testing.assert_array_equal(tape.lengths, np.minimum(results["length"], most))
    for episode, length in enumerate(tape.lengths.tolist()):
        taken = [tape.state(episode, t)["action"][0] for t in range(length)]
        assert len(set(map(float, taken))) == length  # a random one for each step
        if length == results["length"][episode]:
            effort = np.abs(taken).mean()
            # a mean of at most three numbers in float32
            assert effort == pytest.approx(results["effort"][episode], rel=1e-5)
    assert tape.first(2).count == 2


def test_agents_with_the_same_key_meet_the_same_tasks(results):
    other = evaluate.run_episodes(toys.Counter(), zero_agent(1), EPISODES, KEY)
    np.testing.assert_array_equal(other["length"], results["length"])
    assert (other["effort"] == 0.0).all()
    assert (results["effort"] > 0.0).all()


def test_the_summary_counts_what_the_episodes_say(results):
    summary = evaluate.summarise(results, toys.Counter().metrics)
    hits = int(results["collision"].sum())
    assert summary["episodes"] == EPISODES
    assert summary["return_mean"] == pytest.approx(-hits / EPISODES)
    assert summary["collision_episodes"] == hits
    low, high = summary["collision_rate_ci95"]
    assert low < summary["collision_rate"] == hits / EPISODES < high
    steps = results["length"].sum()
    assert summary["collision_per_1000_steps"] == pytest.approx(1000 * hits / steps)
    assert summary["success_rate"] == 0.0
    assert summary["effort_max"] == pytest.approx(float(results["effort"].max()))
    assert summary["clearance_min"] == pytest.approx(-0.9)
    assert summary["clearance_p05"] <= summary["clearance_mean"] <= 0.1
    low, high = summary["effort_mean_ci95"]
    assert low < summary["effort_mean"] < high


def test_an_episode_that_becomes_nonfinite_is_lost_and_counted():
    env = toys.Exploding()
    results = evaluate.run_episodes(env, zero_agent(1), EPISODES, KEY)
    assert 0 < results["lost"].sum() < EPISODES
    assert np.isfinite(results["return"]).all()


def test_a_loaded_policy_acts_as_the_trained_one(finished):
    folder, result, config = finished
    step, agent = load_agent(toys.Counter(), config, folder, True, pytest.fail)
    obs = jax.random.normal(KEY, (5, 3))
    assert step == result.iterations
    np.testing.assert_array_equal(agent(obs, KEY), result.agent(obs, KEY))


@pytest.fixture(scope="module")
def recorded():
    """The same episodes, the first four on tape."""
    return evaluate.record_episodes(
        toys.Counter(), random_agent(1), EPISODES, KEY, recorded=4
    )


def test_recording_changes_no_value(results, recorded):
    for name, values in results.items():
        np.testing.assert_array_equal(recorded[0][name], values)


def test_a_recording_holds_each_state_from_the_reset_to_the_end(results, recorded):
    tape = recorded[1]
    np.testing.assert_array_equal(tape.lengths, results["length"][:4])
    for episode, length in enumerate(tape.lengths):
        states = [tape.state(episode, t) for t in range(length + 1)]
        assert [float(s.obs[1]) for s in states] == list(range(length + 1))
        ended = float(states[-1].done) == 1.0
        assert ended or length == toys.Counter().episode_length
        beyond = tape.state(episode, int(length) + 3)
        np.testing.assert_array_equal(beyond.obs, states[-1].obs)


def test_a_long_episode_is_recorded_up_to_the_limit(monkeypatch):
    monkeypatch.setattr(recording, "MAX_STEPS", 3)
    env = toys.EndlessReward()
    results, tape = evaluate.record_episodes(env, zero_agent(1), 2, KEY, recorded=9)
    assert (results["length"] == 5).all()
    assert tape.count == 2 and (tape.lengths == 3).all()
    assert int(tape.state(1, 9).data["t"]) == 3


def test_no_event_in_n_trials_is_bounded_by_the_closed_form():
    low, high = clopper_pearson(0, 100)
    assert low == 0.0
    assert high == pytest.approx(1 - 0.025 ** (1 / 100), rel=1e-9)  # exact


def test_the_interval_is_symmetric_under_counting_the_failures():
    low, high = clopper_pearson(7, 50)
    other_low, other_high = clopper_pearson(43, 50)
    assert (low, high) == pytest.approx((1 - other_high, 1 - other_low), abs=1e-9)


@pytest.mark.parametrize("counts", [(-1, 10), (11, 10), (0, 0)])
def test_impossible_counts_are_refused(counts):
    with pytest.raises(ValueError, match="impossible"):
        clopper_pearson(*counts)


def test_deviation_of_a_single_value_is_zero():
    assert mean_sd(np.array([3.0])) == (3.0, 0.0)


def test_bootstrap_interval_is_near_the_normal_one():
    values = np.random.default_rng(0).normal(size=400)
    low, high = bootstrap_mean(values)
    half = 1.96 * values.std() / 20
    # 2,000 resamples leave a few per cent of noise in the quantiles
    assert (low, high) == pytest.approx(
        (values.mean() - half, values.mean() + half), abs=0.15 * half
    )


def test_bootstrap_of_a_constant_is_that_constant():
    assert bootstrap_mean(np.full(5, 2.0)) == (2.0, 2.0)


def test_more_episodes_than_fit_are_refused():
    evaluate.check_size(toys.Counter(), 10**6)
    with pytest.raises(ConfigError, match="lower the number of episodes"):
        evaluate.check_size(toys.Counter(), 2**30)
