"""The batch of environments that Brax's trainer steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx.training.brax.environment import Batch
from tests.training import toys

COUNT, STEPS = 6, 24


def played(env, report_every=STEPS):
    """States after each step of zero actions, and the reports."""
    reports = []
    batch = Batch(env, report_every, reports.append)

    @jax.jit
    def play(key):
        start = batch.reset(jax.random.split(key, COUNT))
        action = jnp.zeros((COUNT, env.action_size))

        def step(state, _):
            state = batch.step(state, action)
            return state, (state.obs, state.reward, state.done, state.info)

        return start.obs, jax.lax.scan(step, start, None, length=STEPS)[1]

    result = jax.device_get(play(jax.random.PRNGKey(0)))
    jax.effects_barrier()
    return result, reports


@pytest.fixture(scope="module")
def counted():
    return played(toys.Counter())


def test_an_episode_that_ends_is_followed_by_a_new_start(counted):
    (first, (obs, _, done, _)), _ = counted
    draws = np.concatenate([first[None], obs])[..., 2]  # one number for each start
    changed = draws[1:] != draws[:-1]
    assert np.array_equal(changed, done > 0.5)
    assert len(np.unique(draws)) == COUNT + done.sum()


def test_the_time_limit_truncates_and_the_task_terminates(counted):
    (_, (_, reward, done, info)), _ = counted
    truncation = info["truncation"]
    assert truncation.sum() and (done - truncation).sum()
    assert np.array_equal(done - truncation, -reward)  # the toy's end costs 1


def test_a_report_has_the_sums_of_all_steps(counted):
    (_, (_, reward, done, _)), (report,) = counted
    assert report.step_sums["collision"] == -reward.sum()
    assert 0 < report.episodes <= done.sum()  # without those that only staggering cut
    assert report.episode_sums["return"] == reward.sum()


def test_reports_come_at_equal_distances():
    _, reports = played(toys.Counter(), report_every=STEPS // 4)
    assert len(reports) == 4


def test_a_step_that_becomes_nonfinite_is_left_out_by_braxs_losses():
    (_, (obs, reward, done, info)), (report,) = played(toys.Exploding())
    assert report.nonfinite > 0
    assert np.isfinite(obs).all() and np.isfinite(reward).all()
    left_out = info["truncation"] > 0.5
    assert left_out.sum() == report.nonfinite
    assert (done[left_out] == 1.0).all() and (reward[left_out] == 0.0).all()
