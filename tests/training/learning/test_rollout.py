"""Rollouts: time limits, resets and episode statistics against a plain loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx.metric import REDUCTIONS
from rmp_mjx.training.learning import episodes, rollout
from tests.training import toys

NUM_ENVS, LENGTH = 8, 12


def act(obs, keys):
    raw = jax.vmap(lambda key: jax.random.normal(key, (1,)))(keys)
    return raw, {"raw_action": raw, "log_prob": raw[:, 0]}


def unroll_twice(env):
    def run(key):
        keys = jax.random.split(key, NUM_ENVS)
        others = jax.random.split(jax.random.key(7), NUM_ENVS)
        state = rollout.init(env, keys)
        state, first, a = rollout.unroll(env, act, state, keys, LENGTH)
        _, second, b = rollout.unroll(env, act, state, others, LENGTH)
        data = jax.tree.map(lambda *x: jnp.concatenate(x), first, second)
        return data, rollout.total(jax.tree.map(jnp.add, a, b))

    return jax.device_get(jax.jit(run)(jax.random.key(0)))


@pytest.fixture(scope="module")
def counted():
    return unroll_twice(toys.Counter())


def replay(data):
    """Episodes as a plain loop finds them: (return, length, truncated, effort)."""
    episodes = []
    for lane in range(NUM_ENVS):
        total, steps, effort = 0.0, 0, []
        for t in range(data.reward.shape[0]):
            total, steps = total + data.reward[t, lane], steps + 1
            effort.append(abs(float(data.raw_action[t, lane, 0])))
            cut = data.truncation[t, lane] > 0
            if data.termination[t, lane] > 0 or cut:
                episodes.append((total, steps, cut, np.mean(effort)))
                total, steps, effort = 0.0, 0, []
    return episodes


def test_episode_sums_equal_those_of_a_plain_loop(counted):
    data, stats = counted
    episodes = replay(data)
    assert stats.episodes == len(episodes) > 20
    # integers below 2^24: exact in float32
    assert stats.episode_sums["return"] == sum(e[0] for e in episodes)
    assert stats.episode_sums["length"] == sum(e[1] for e in episodes)
    assert stats.episode_sums["collision"] == sum(not e[2] for e in episodes)
    # sums of float32 means in another order
    effort = sum(e[3] for e in episodes)
    np.testing.assert_allclose(stats.episode_sums["effort"], effort, rtol=1e-5)


def test_step_sums_count_events_of_all_steps(counted):
    data, stats = counted
    assert stats.step_sums["collision"] == data.termination.sum()


def test_episodes_are_truncated_at_the_time_limit_and_only_there(counted):
    data, _ = counted
    step, length = data.next_obs[..., 1], data.obs[..., 0]
    limit = toys.Counter().episode_length
    np.testing.assert_array_equal(data.termination, step >= length)
    np.testing.assert_array_equal(data.truncation, (step < length) & (step == limit))
    assert data.truncation.sum() > 0


def test_a_reset_draws_a_new_start_each_time(counted):
    data, stats = counted
    starts = {
        (lane, float(data.obs[t, lane, 2]))
        for t in range(data.obs.shape[0])
        for lane in range(NUM_ENVS)
    }
    begun = {float(draw) for _, draw in starts}
    assert len(begun) == len(starts) >= int(stats.episodes)


def test_next_observation_is_that_before_the_reset(counted):
    data, _ = counted
    np.testing.assert_array_equal(data.next_obs[..., 1], data.obs[..., 1] + 1)
    np.testing.assert_array_equal(data.next_obs[..., 2], data.obs[..., 2])


def test_environments_go_on_across_unrolls(counted):
    data, _ = counted
    going_on = (data.termination + data.truncation)[LENGTH - 1] == 0
    after, before = data.obs[LENGTH], data.next_obs[LENGTH - 1]
    np.testing.assert_array_equal(after[going_on], before[going_on])


def test_nonfinite_steps_are_masked_counted_and_reset():
    data, stats = unroll_twice(toys.Exploding())
    bad = data.obs[..., 0] > 0.5
    assert stats.nonfinite == bad.sum() > 0
    np.testing.assert_array_equal(data.weight, ~bad)
    assert stats.episodes == (~bad).sum()
    for leaf in jax.tree.leaves((data, stats)):
        assert np.isfinite(leaf).all()


def test_a_step_is_finite_below_a_million():
    """Observation and reward, either sign; or an environment says itself that it is
    not. What is not finite ends, with nothing but its old observation."""

    class Told:
        """Steps to what the action says."""

        def step(self, state, action):
            obs, reward, flag, effort, done = action[:2], *action[2:]
            metrics = {rollout.NONFINITE: flag, "effort": effort}
            return state.replace(obs=obs, reward=reward, done=done, metrics=metrics)

    good = [[5.0, -9e5, 9e5, 0.0, 2.0, 0.0], [0.0, 9e5, -9e5, 0.4, np.nan, 1.0]]
    bad = [[1e6, 0, 0, 0, 2, 0], [0, -1e6, 0, 0, 2, 0], [0, 0, 1e6, 0, 2, 0]]
    bad += [[0, 0, -1e6, 0, 2, 0], [0, 0, 0, 0.5, 2, 0], [np.nan, 0, 0, 0, 2, 0]]
    action = jnp.array(good + bad)
    k = len(action)
    one = jnp.ones(k)
    old = toys.ToyState(one, jnp.full((k, 2), 7.0), one, one, {}, {})
    new, finite = rollout.finite_step(Told(), old, action)  # type: ignore[arg-type]
    np.testing.assert_array_equal(finite, [True, True] + [False] * len(bad))
    np.testing.assert_array_equal(new.obs[:2], action[:2, :2])
    np.testing.assert_array_equal(new.obs[2:], 7.0)
    np.testing.assert_array_equal(new.reward, [9e5, -9e5] + [0.0] * len(bad))
    np.testing.assert_array_equal(new.done, [0.0, 1.0] + [1.0] * len(bad))
    np.testing.assert_array_equal(new.metrics["effort"], [2.0] + [0.0] * (k - 1))


def test_the_first_bad_step_of_an_unroll_is_kept_with_what_led_to_it():
    """Of each environment; a later unroll begins without any."""
    env = toys.Exploding()

    @jax.jit
    def run(key):
        keys = jax.random.split(key, NUM_ENVS)
        state = rollout.init(env, keys)
        state, data, _ = rollout.unroll(env, act, state, keys, LENGTH)
        later, again, _ = rollout.unroll(env, act, state, keys, 1)
        return (state.fault, data), (later.fault, again)

    bad = np.zeros(0)
    for fault, data in jax.device_get(run(jax.random.key(0))):
        bad = data.weight == 0
        np.testing.assert_array_equal(fault.happened, bad.any(axis=0))
        first = bad.argmax(axis=0)
        for lane in np.flatnonzero(fault.happened):
            led = data.raw_action[first[lane], lane]
            np.testing.assert_array_equal(fault.action[lane], led)
            assert fault.env_state.obs[lane, 0] == 1.0
    assert 0 < bad.sum() < NUM_ENVS  # the last unroll has both


def test_an_environment_may_restart_from_its_last_episode():
    """Every episode ends after a step; the first start has none before it."""

    class Lives(toys.ActionChoice):
        def restart(self, rng, ended):
            count = 0 if ended is None else ended.data["t"] + 1
            fresh = self.reset(rng)
            return fresh.replace(data={"t": jnp.int32(count), "key": rng})

    env, keys = Lives(), jax.random.split(jax.random.key(0), NUM_ENVS)
    state = rollout.init(env, keys)
    np.testing.assert_array_equal(state.env_state.data["t"], 0)
    state, _, stats = jax.jit(
        lambda state: rollout.unroll(env, act, state, keys, LENGTH)
    )(state)
    np.testing.assert_array_equal(state.env_state.data["t"], LENGTH)
    np.testing.assert_array_equal(stats.episodes, LENGTH)


def test_staggered_starts_spread_the_time_limit_and_count_whole_episodes_only():
    """`Counter` ends an episode by itself or by the time limit."""
    env = toys.Counter()
    limit = env.episode_length

    @jax.jit
    def run(key):
        keys = jax.random.split(key, 64)
        state = rollout.init(env, keys, staggered=True)
        _, data, stats = rollout.unroll(env, act, state, keys, 3 * limit)
        return state, data, rollout.total(stats)

    start, data, stats = jax.device_get(run(jax.random.key(0)))
    assert len(np.unique(start.age)) == limit
    ends = (data.truncation + data.termination) > 0
    first = np.argmax(ends, axis=0)
    np.testing.assert_array_equal(
        first <= limit - 1 - start.age, np.ones_like(first, bool)
    )
    cut = np.take_along_axis(data.truncation, first[None], 0)[0] > 0
    partial = cut & (start.age > 0)
    assert partial.sum() > 10
    assert stats.episodes == ends.sum() - partial.sum()


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
