"""The tuner's parameters, its two figures and its pooling, without a simulation."""

import dataclasses
from typing import Any

import jax
import numpy as np
import optuna
import pytest

import rmp_mjx as rmp
from benchmarks.studies import tune
from benchmarks.studies.parameters import Parameters
from benchmarks.studies.tune import Tally


def run(steps_free=10.0, reached=1.0, **tallies):
    """What a bench returns; scenes as `fixed_hard=Tally(...)`."""
    named = {name.replace("_", "/"): tally for name, tally in tallies.items()}
    return {"tallies": named, "steps_free": steps_free, "reached": {"far": reached}}


def tally(collisions=0, limits=0, moved=10.0, jump=0.0):
    return Tally(1000, collisions, limits, commanded=100.0, moved=moved, jump=jump)


def test_the_parameters_start_at_the_default_leaves(robot):
    tuned, default = Parameters().controller(robot), rmp.RMPVICES(robot)
    assert jax.tree.structure(tuned) == jax.tree.structure(default)
    jax.tree.map(np.testing.assert_array_equal, tuned, default)


def test_every_parameter_reaches_the_controller(robot):
    """Changing any one of them changes a leaf of the controller."""
    default = jax.tree.leaves(Parameters().controller(robot))
    for field in dataclasses.fields(Parameters):
        changed = Parameters(
            **{field.name: 1.5 * getattr(Parameters(), field.name)}
        ).controller(robot)
        pairs = zip(jax.tree.leaves(changed), default, strict=True)
        assert any(not np.array_equal(a, b) for a, b in pairs), field.name


def test_the_defaults_lie_in_the_search_space_that_names_them_all():
    trial: Any = optuna.trial.FixedTrial(dataclasses.asdict(Parameters()))
    assert Parameters.suggest(trial) == Parameters()
    assert trial.distributions.keys() == dataclasses.asdict(Parameters()).keys()
    for name, value in dataclasses.asdict(Parameters()).items():
        space = trial.distributions[name]
        assert space.low <= value <= space.high, name


def test_the_score_of_the_baseline_itself_is_all_events_and_no_loss():
    vices = run(fixed_hard=tally(10, 20), door_hard=tally(5, 0))
    assert tune.score(vices, vices) == (1.0, 0.0)


def test_events_left_are_a_mean_over_the_events_that_the_baseline_has():
    vices = run(fixed_hard=tally(10, 20), door_hard=tally(4, 8))
    ours = run(fixed_hard=tally(1, 0), door_hard=tally(4, 2))
    # 1 of 10, 0 of 20, 2 of 8; four collisions at the door are too few to compare.
    left, lost = tune.score(ours, vices)
    assert left == pytest.approx((0.1 + 0.0 + 0.25) / 3)
    assert lost == 0.0


def test_lost_progress_sums_up_what_a_user_would_miss():
    vices = run(steps_free=10.0, fixed_hard=tally(9), door_hard=tally(9))
    ours = run(
        steps_free=11.0,
        reached=0.9,
        fixed_hard=tally(9, moved=8.0),  # a fifth less
        door_hard=tally(9, moved=12.0),  # more does not make up for it
    )
    # Mean loss of progress, slower reaching, missed targets.
    assert tune.score(ours, vices)[1] == pytest.approx(0.1 + 0.1 + 0.1)


def test_the_adversary_counts_for_events_but_not_for_progress():
    vices, ours = (
        run(fixed_hard=tally(10), fixed_adversarial=tally(100, moved=moved))
        for moved in (50.0, 1.0)
    )
    assert tune.score(ours, vices) == (1.0, 0.0)


def test_a_tally_counts_self_collisions_with_collisions():
    figures = {
        "collision": np.array([[1, 0], [0, 1]]),
        "self_collision": np.array([[0, 0], [1, 0]]),
        "joint_limit": np.array([[0, 1], [0, 0]]),
        "commanded": np.full((2, 2), 2.0),
        "moved": np.full((2, 2), 0.5),
        "torque_jump": np.array([[1.0, 7.0], [3.0, 2.0]]),
    }
    total = Tally()
    total.add(figures)
    total.add(figures)
    assert (total.steps, total.collisions, total.limits) == (8, 6, 2)
    assert total.progress == 0.25 and total.jump == 7.0


def test_pooled_seeds_add_up_and_keep_the_largest_jump():
    runs = [
        run(10.0, 0.8, fixed_hard=tally(1, 2, jump=5.0)),
        run(14.0, 1.0, fixed_hard=tally(3, 0, jump=3.0)),
    ]
    total = tune.pooled(runs)
    assert total["tallies"]["fixed/hard"] == Tally(2000, 4, 2, 200.0, 20.0, 5.0)
    assert total["steps_free"] == 12.0
    assert total["reached"]["far"] == pytest.approx(0.9)


def test_the_report_says_what_is_left_of_how_many():
    vices, ours = run(fixed_hard=tally(50, 10)), run(fixed_hard=tally(5, 0))
    rows = {row.key: row for row in tune.report_rows("new", ours, vices)}
    assert rows["new/collisions_left"].value == pytest.approx(0.1)
    assert rows["new/limits_left"].value == 0.0
    assert rows["new/collisions_left"].note.startswith("5 of 50;")
    assert rows["new/fixed/hard/progress"].value == 1.0


def test_the_plot_is_drawn(tmp_path):
    trials = [{"left": 0.02, "lost": 0.3}, {"left": 0.0, "lost": 0.4}]
    tune.plot(trials, tmp_path / "new" / "trade.png")
    assert (tmp_path / "new" / "trade.png").read_bytes().startswith(b"\x89PNG")
