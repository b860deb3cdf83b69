"""The comparison of our loop with Brax's own, at a small size."""

import pytest

from benchmarks.studies import parity

SMALL = {"num_envs": 8, "unroll_length": 8, "hidden_sizes": (4,)}
SMALL |= {"num_minibatches": 2, "num_updates_per_batch": 1}


def test_a_summary_has_curve_interval_and_last_return():
    curves = [[(5, 0.0), (10, 1.0)], [(5, 2.0), (10, 5.0)]]
    found = parity.summary(curves)
    assert found["steps"] == [5, 10]
    assert found["return"] == [1.0, 3.0]
    assert found["low"] == [0.0, 1.0] and found["high"] == [2.0, 5.0]
    assert found["last"][0] == 3.0


@pytest.mark.parametrize("task", parity.TASKS)
def test_both_loops_have_as_many_trials(task):
    ours, brax = (parity.trials(which, task) for which in ("ours", "brax"))
    assert len(ours) == len(brax) == len({str(trial) for trial in brax}) == 4
    assert len({trial["reward_scaling"] for trial in brax}) == 2


@pytest.mark.parametrize("which", parity.LOOPS)
def test_each_loop_is_judged_at_equal_distances(which, monkeypatch):
    monkeypatch.setattr(parity, "SIZES", SMALL)
    judged = []

    def judge(agent):
        judged.append(agent)
        return float(len(judged))

    task, options = parity.load("reach")
    curve = parity.train(which, task, options, judge, 2, num_timesteps=256, seed=0)
    assert curve == [(128, 1.0), (256, 2.0)]
