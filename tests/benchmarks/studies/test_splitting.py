"""Subset simulation: rates known by heart, and worlds as the environment draws them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import envs
from benchmarks.studies import splitting
from rmp_mjx.training.learning.networks import zero_agent


class Tail:
    """A sum of ten standard normal numbers beyond a bound."""

    def __init__(self, rate):
        self.bound = stats.norm.isf(rate)

    def draw(self, key, count):
        return jax.random.normal(key, (count, 10))

    def move(self, key, samples, size):
        near = jnp.sqrt(1 - size**2) * samples
        fresh = jax.random.normal(key, samples.shape)
        return near + size * fresh, jnp.ones(len(samples), bool)

    def level(self, samples):
        return self.bound - np.asarray(samples, float).sum(-1) / np.sqrt(10)


@pytest.mark.parametrize("rate", [1e-2, 1e-6])
def test_a_gaussian_tail_is_within_the_interval_of_its_repeats(rate):
    """Nineteen of twenty such intervals hold it; this is one of those."""
    problem = Tail(rate)
    runs = [
        splitting.estimate(problem, key, 500)
        for key in jax.random.split(jax.random.key(1), 10)
    ]
    low, high = splitting.over_repeats([run.rate for run in runs])
    assert low <= rate <= high < 3 * rate
    assert all(np.all(np.diff(run.levels) < 0) for run in runs)
    assert max(run.evaluations for run in runs) < 5000
    if rate == 1e-2:
        events, (least, greatest) = splitting.counted(
            problem, jax.random.key(1), 8, 500
        )
        assert events and least <= high and low <= greatest


def test_what_cannot_be_reached_has_the_rate_zero():
    found = splitting.estimate(Tail(1e-30), jax.random.key(0), 100, most=3)
    assert found.rate == 0.0 and len(found.levels) == 3


@pytest.fixture(scope="module")
def episodes():
    env = envs.load(
        "trajectory",
        controller="vices",
        obstacles=2,
        layout="close",
        obstacle_speed=0.2,
        episode_length=20,
    )
    return splitting.Episodes(env, zero_agent(env.action_size))


def test_worlds_are_drawn_and_moved_as_the_layout_allows(episodes):
    """The centres' mean and spread against those of 400 resets: within four errors."""
    worlds = episodes.draw(jax.random.key(0), 400)
    states, fits = jax.jit(jax.vmap(episodes.world))(worlds)
    assert np.all(fits)
    resets = jax.jit(jax.vmap(episodes.env.reset))(
        jax.random.split(jax.random.key(1), 400)
    )
    ours, theirs = (
        np.asarray(s.data.mocap_pos).reshape(-1, 3) for s in (states, resets)
    )
    error = np.sqrt(ours.var(0) / 800 + theirs.var(0) / 800)
    assert np.all(np.abs(ours.mean(0) - theirs.mean(0)) < 4 * error)
    np.testing.assert_allclose(ours.std(0), theirs.std(0), rtol=0.15)
    speeds = np.linalg.norm(states.info["spheres"].velocity, axis=-1)
    np.testing.assert_allclose(speeds, 0.2, rtol=1e-5)
    moved, valid = episodes.move(jax.random.key(2), worlds, 0.3)
    _, fits = jax.jit(jax.vmap(episodes.world))(moved)
    np.testing.assert_array_equal(valid, fits)
    kept = np.asarray(jax.random.key_data(moved.key) == jax.random.key_data(worlds.key))
    assert 0.7 < kept.all(-1).mean() < 0.9
    near = np.asarray(moved.place - worlds.place)
    assert near.std() == pytest.approx(np.sqrt(2 - 2 * np.sqrt(1 - 0.09)), rel=0.1)


@pytest.mark.slow
def test_counting_agrees_where_it_can_see_and_episodes_repeat(episodes):
    """A resting arm among moving spheres: some reach it within a second."""
    worlds = episodes.draw(jax.random.key(3), 100)
    level = episodes.level(worlds)
    np.testing.assert_array_equal(level, episodes.level(worlds))
    assert np.all(level >= 0.0) and np.any(level > 0.03)
    runs = [
        splitting.estimate(episodes, key, 100)
        for key in jax.random.split(jax.random.key(4), 4)
    ]
    low, high = splitting.over_repeats([run.rate for run in runs])
    events, (least, greatest) = splitting.counted(episodes, jax.random.key(5), 6, 100)
    assert events > 0
    assert least <= high and low <= greatest
