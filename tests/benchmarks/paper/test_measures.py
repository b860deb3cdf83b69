"""Numbers of the paper's page against values by hand and scipy's."""

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import polars as pl
import pytest
from scipy import stats

import envs
from benchmarks.paper import deployment, measures


def rows(values, seed=0, name="episode/collision", finished=1):
    """Training rows of one seed at steps 0, 100, 200, ..."""
    steps = [100 * i for i in range(len(values))]
    return pl.DataFrame(
        {
            "seed": [seed] * len(values),
            "steps": steps,
            name: pl.Series(values, dtype=pl.Float64),
            "episode/finished": [finished] * len(values),
        }
    )


def test_areas_and_their_change_are_those_computed_by_hand():
    """Trapezia: (0 + 1)/2 and (1 + 1)/2 over two intervals, mean .75; 1e-12 rounds."""
    base = measures.curves(rows([0.0, 1.0, 1.0]), "episode/collision")
    ours = measures.curves(rows([0.3, 0.3, 0.3]), "episode/collision")
    own, other = measures.areas(ours, base)
    np.testing.assert_allclose([own[0], other[0]], [0.3, 0.75], rtol=1e-12)
    assert measures.percent_change(own, other) == pytest.approx(-60.0, rel=1e-12)
    assert np.isnan(measures.percent_change(own, np.zeros(1)))


def test_areas_begin_where_both_have_finished_episodes():
    """Ours from step 100 on: (1 + 0)/2 = .5 of VICES' is left, not (2 + 1 + ...)."""
    base = measures.curves(rows([2.0, 1.0, 0.0]), "episode/collision")
    ours = measures.curves(rows([None, 0.1, 0.1]), "episode/collision")
    own, other = measures.areas(ours, base)
    np.testing.assert_allclose([own[0], other[0]], [0.1, 0.5], rtol=1e-12)


def test_gaps_in_a_curve_are_bridged():
    bridged = measures.curves(rows([1.0, None, 3.0]), "episode/collision")
    np.testing.assert_array_equal(bridged.values, [[1.0, 2.0, 3.0]])


def test_the_band_is_students_interval():
    """Against scipy's own, 1e-12: rounding."""
    values = np.random.default_rng(0).normal(size=(5, 3))
    mean, (low, high) = measures.band(values)
    expected = stats.t.interval(0.95, 4, values.mean(0), stats.sem(values))
    np.testing.assert_allclose(mean, values.mean(0), rtol=1e-12)
    np.testing.assert_allclose([low, high], expected, rtol=1e-12)
    _, (low, high) = measures.band(values[:1])
    np.testing.assert_array_equal(low, high)


def test_the_best_seed_is_the_best_at_the_end():
    early = rows([9.0] * 18 + [1.0] * 3, seed=0, name="episode/return")
    late = rows([0.0] * 18 + [2.0] * 3, seed=1, name="episode/return")
    assert measures.best_seed(pl.concat([early, late])) == 1
    nothing = rows([9.0] * 18 + [None] * 3, 2, "episode/return", finished=0)
    assert measures.best_seed(pl.concat([nothing, late])) == 1


def test_training_forces_are_means_over_the_episodes_that_collided():
    """4 episodes with a mean of 30 N, 3 of them collided: 40 N, three times."""
    frame = pl.DataFrame(
        {
            "episode/finished": [4, 2, 0],
            "episode/collision": [0.5, 0.0, None],
            "episode/self_collision": [0.25, 0.0, None],
            "episode/contact_force_peak": [30.0, 0.0, None],
        }
    )
    force, number = measures.training_forces(frame)
    np.testing.assert_allclose(force, [40.0])
    np.testing.assert_allclose(number, [3.0])


def test_rates_have_scipys_exact_interval():
    """Clopper and Pearson by the beta distribution, 1e-6 of a per cent."""
    rate = measures.Rate(7, 100)
    expected = stats.beta.ppf([0.025, 0.975], [7, 8], [94, 93])
    np.testing.assert_allclose(rate.interval, 100.0 * expected, atol=1e-6)


def test_paired_tests_are_scipys():
    own, other = {0: 1.0, 1: 3.0, 2: 2.5, 4: 9.0}, {0: 0.5, 1: 1.0, 2: 2.7, 3: 0.0}
    found = measures.paired(own, other)
    gaps = np.array([0.5, 2.0, -0.2])
    assert found is not None and found.pairs == 3
    reference = stats.ttest_rel([1.0, 3.0, 2.5], [0.5, 1.0, 2.7])
    assert found.p_t == pytest.approx(reference.pvalue, rel=1e-9)
    low, high = reference.confidence_interval(0.95)
    np.testing.assert_allclose(found.interval, (low, high), rtol=1e-9)
    assert found.effect == pytest.approx(gaps.mean() / gaps.std(ddof=1), rel=1e-12)
    flips = stats.permutation_test(
        (gaps,), np.mean, permutation_type="samples", n_resamples=10**6
    )
    assert found.p_sign == pytest.approx(flips.pvalue, abs=1e-9)
    assert measures.paired({0: 1.0}, {0: 0.0}) is None


def test_the_change_has_an_interval_from_three_seeds_on():
    own, base = np.array([1.0, 2.0, 1.5]), np.array([10.0, 11.0, 9.0])
    interval = measures.change_interval(own, base)
    assert interval is not None
    low, high = interval
    assert low <= measures.percent_change(own, base) <= high < 0.0
    assert measures.change_interval(own[:2], base[:2]) is None


def test_events_are_put_down_to_what_is_nearest():
    """A ball in the hand; joint 2 0.05 rad from its lower limit. 1e-9: rounding."""
    env = envs.load("push", controller="vices", physics="mujoco", obstacles=2)
    model = env.scene.model
    data = mujoco.MjData(model)
    at_home, low = np.array(model.qpos0), np.array(model.qpos0)
    at_home[:7] = low[:7] = env.robot.q_home
    low[1] = env.robot.q_lower[1] + 0.05
    data.qpos[:] = at_home
    mujoco.mj_kinematics(model, data)
    away = np.array([0.0, 0.0, -5.0])
    ball = np.stack([away, data.geom("arm/fingers").xpos])
    states = [
        SimpleNamespace(data=SimpleNamespace(qpos=at_home, mocap_pos=ball)),
        SimpleNamespace(
            data=SimpleNamespace(qpos=low, mocap_pos=np.tile(away, (2, 1)))
        ),
    ]
    tape: Any = SimpleNamespace(
        lengths=np.array([3, 4]), state=lambda k, step: states[k]
    )
    results = {
        "length": np.array([3.0, 4.0]),
        "collision": np.array([1.0, 0.0]),
        "self_collision": np.zeros(2),
        "joint_limit": np.array([0.0, 1.0]),
        "contact_force_peak": np.array([33.0, 0.0]),
    }
    hit, limit = pl.DataFrame(
        deployment.describe(env, results, tape), deployment.SCHEMA
    ).iter_rows(named=True)
    assert (hit["first"], hit["second"]) == ("arm/fingers", "sphere_1")
    assert (hit["hand"], hit["force"], hit["step"]) == (True, 33.0, 3)
    assert hit["gap"] < 0.0
    assert (limit["first"], limit["second"]) == ("joint 2", "lower limit")
    assert limit["gap"] == pytest.approx(0.05, abs=1e-9)
