"""Folding of per-step values into an episode's."""

import jax.numpy as jnp
import numpy as np

from rmp_mjx.metric import REDUCTIONS
from rmp_mjx.training.learning import episodes

KINDS = {name: name for name in REDUCTIONS}
STEPS = ([3.0, -1.0], [1.0, 2.0], [2.0, 0.0])


def fold(state, steps):
    for values in steps:
        metrics = dict.fromkeys(KINDS, jnp.array(values))
        state = episodes.update(state, jnp.ones(2), metrics, KINDS)
    return state


def test_each_reduction_folds_as_it_says():
    values = episodes.finish(fold(episodes.start(KINDS, (2,)), STEPS), KINDS)
    rows = np.array(STEPS)
    expected = {
        "sum": rows.sum(0),
        "max": rows.max(0),
        "min": rows.min(0),
        "mean": rows.mean(0),
        "last": rows[-1],
        "return": [3.0, 3.0],
        "length": [3.0, 3.0],
    }
    assert values.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_allclose(values[name], value, rtol=1e-6)


def test_a_restarted_episode_remembers_nothing_and_the_others_all():
    state = fold(episodes.start(KINDS, (2,)), STEPS[:2])
    state = episodes.restart(state, jnp.array([True, False]), KINDS)
    values = episodes.finish(fold(state, STEPS[2:]), KINDS)
    for name in ("sum", "max", "min", "mean", "last"):
        assert values[name][0] == 2.0  # its one step
    assert (values["min"][1], values["max"][1], values["length"][1]) == (-1.0, 2.0, 3.0)
