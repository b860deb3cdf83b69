"""What every task promises: to our trainer, to Brax's and to Playground's wrappers."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers import training as brax_training

import envs
from envs.brax import BraxTask
from tests.envs.arm_tasks import Torques

LANES = 4
LIMIT = 5
"""Steps of an episode for the wrappers."""


@pytest.fixture(scope="module", params=envs.names())
def task(request):
    """Each task with its default controller, its vmapped reset and step compiled."""
    env = envs.load(request.param, physics="mujoco", obstacles=2)
    return SimpleNamespace(
        env=env, reset=jax.jit(jax.vmap(env.reset)), step=jax.jit(jax.vmap(env.step))
    )


@pytest.fixture(scope="module", params=envs.names())
def limp(request):
    """Each task with a controller that compiles fast, and with an observer."""
    controller = Torques(jnp.zeros(7))
    options = {"observer": "momentum", "observer_noise": 0.01, "observer_delay": 0.01}
    return envs.load(
        request.param, controller=controller, physics="mujoco", obstacles=2, **options
    )


def keys(seed, count=LANES):
    return jax.random.split(jax.random.key(seed), count)


def raw_keys(seed):
    """Keys as Brax takes them: it reads the batch size off their second-last axis."""
    return jax.random.split(jax.random.PRNGKey(seed), LANES)


def actions(env, seed, *shape):
    """Uniform actions, (*shape, actions)."""
    key = jax.random.key(seed)
    return jax.random.uniform(key, (*shape, env.action_size), minval=-1.0)


def plain(tree):
    """Arrays of a state, random keys as numbers."""

    def numbers(x):
        is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(x) if is_key else x)

    return jax.tree.map(numbers, tree)


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, plain(a), plain(b))


def layout(tree):
    """Structure, shapes and types."""
    return jax.tree.map(lambda x: (x.shape, x.dtype), tree)


def test_a_step_keeps_the_states_structure_and_says_what_it_promised(task):
    start = task.reset(keys(0))
    state = task.step(start, actions(task.env, 0, LANES))
    assert layout(state) == layout(start)
    assert state.obs.shape == (LANES, task.env.observation_size)
    assert state.reward.shape == state.done.shape == (LANES,)
    assert state.metrics.keys() == task.env.metrics.keys()
    assert "success" in state.metrics
    for value in (state.obs, state.reward, state.done, *state.metrics.values()):
        assert value.dtype == jnp.float32


def test_the_key_alone_decides_an_episode(task):
    def play():
        state = task.reset(keys(1))
        for step in range(3):
            state = task.step(state, actions(task.env, step, LANES))
        return state

    once = play()
    assert_equal(once, play())
    first, second = (task.reset(keys(seed)) for seed in (1, 2))
    assert not np.array_equal(first.obs, second.obs)
    assert len(np.unique(first.obs, axis=0)) == LANES


def test_random_steps_stay_finite(task):
    state = task.reset(keys(3))
    chosen = actions(task.env, 3, 300, LANES)
    bad = jnp.zeros(LANES)
    for action in chosen:
        state = task.step(state, action)
        bad += state.metrics["nonfinite"]
        bad += ~jnp.isfinite(state.reward) | ~jnp.isfinite(state.obs).all(-1)
    assert not np.any(bad)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(plain(state)))


def test_a_batch_is_a_loop_over_its_lanes(limp):
    """Within 1e-4: XLA orders float32 sums by the batch's shape."""
    start = jax.jit(jax.vmap(limp.reset))(keys(4))
    action = actions(limp, 4, LANES)
    batched = jax.jit(jax.vmap(limp.step))(start, action)
    one = jax.jit(limp.step)
    for lane in range(2):
        alone = one(jax.tree.map(lambda x, i=lane: x[i], start), action[lane])
        lanes = jax.tree.map(lambda x, i=lane: x[i], batched)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4),
            plain(alone),
            plain(lanes),
        )


def test_the_observation_is_documented_entry_by_entry(limp):
    header, *rows = envs.describe(limp.name).splitlines()
    assert header.split() == ["entries", "name", "unit", "meaning"]
    names, end = [], 0
    for row in rows:
        place, name, unit, meaning = row.split(maxsplit=3)
        low, _, high = place.partition(":")
        assert int(low) == end, f"{name} does not follow on what is before it"
        end = int(high or end + 1)
        assert unit and len(meaning) > 5
        names.append(name)
    assert end == limp.observation_size
    assert len(set(names)) == len(names)


def roll(step, start):
    """One scan up to the time limit, at rest: the state's structure must last."""

    def body(state, action):
        state = step(state, action)
        return state, (state.obs, state.done, state.info)

    still = jnp.zeros((LIMIT, LANES, 12))
    return jax.jit(lambda s: jax.lax.scan(body, s, still))(start)


def test_braxs_wrappers_accept_it(limp):
    """An episode is cut off at the limit, and the first state comes back whole."""
    wrapped = brax_training.wrap(BraxTask(limp), episode_length=LIMIT)
    wrapped = brax_training.EvalWrapper(wrapped)
    start = jax.jit(wrapped.reset)(raw_keys(5))
    state, (obs, done, info) = roll(wrapped.step, start)
    ended = np.argmax(done, axis=0)
    assert np.all(np.max(done, axis=0) == 1)
    for lane in range(LANES):
        np.testing.assert_array_equal(obs[ended[lane], lane], start.obs[lane])
    cut = ended == LIMIT - 1
    assert np.any(info["truncation"][-1][cut] == 1)
    steps = state.info["eval_metrics"].episode_steps
    np.testing.assert_array_equal(steps, ended + 1)
    before, after = (
        jax.tree.map(lambda x: x[cut], s.pipeline_state.info) for s in (start, state)
    )
    assert_equal(before, after)


def full_reset(env):
    """Playground's automatic reset with `full_reset`, by what it asks of a task.

    Where an episode has ended, data, observation and the whole of `info` come from a
    `reset` inside the step; keys that wrappers add to `info` pass through `step`.
    """

    def step(state, action):
        fresh = env.reset(state.info["reset_rng"])
        fresh.info["reset_rng"] = state.info["reset_rng"]
        state = env.step(state.replace(done=jnp.zeros_like(state.done)), action)

        def pick(new, old):
            mask = state.done.reshape(state.done.shape + (1,) * (old.ndim - 1))
            return jnp.where(mask, new, old)

        return state.replace(
            data=jax.tree.map(pick, fresh.data, state.data),
            obs=pick(fresh.obs, state.obs),
            info=jax.tree.map(pick, fresh.info, state.info),
        )

    return step


def test_a_reset_inside_the_step_starts_a_new_episode(limp):
    """Brax's episode wrapper counts in `info` too: its keys must not be the task's."""
    env = brax_training.EpisodeWrapper(
        brax_training.VmapWrapper(limp), episode_length=LIMIT, action_repeat=1
    )
    start = jax.jit(env.reset)(raw_keys(6))
    start.info["reset_rng"] = raw_keys(7)
    state, (_, done, info) = roll(full_reset(env), start)
    going = np.cumsum(done, axis=0) == 0
    counted = np.where(going, np.arange(1, LIMIT + 1)[:, None], 0)
    np.testing.assert_array_equal(np.where(going, info["steps"], 0), counted)
    assert np.all(np.max(done, axis=0) == 1)
    new = done[-1] == 1
    fresh = jax.jit(env.reset)(raw_keys(7))
    assert np.any(new)
    # Two programs of the same reset: float32 rounds otherwise in the last place.
    np.testing.assert_allclose(state.obs[new], fresh.obs[new], rtol=0, atol=1e-6)


@pytest.mark.parametrize("full", [True, False])
def test_playgrounds_wrapper_accepts_it(limp, full):
    """Where the package is installed (it is not among the locked ones)."""
    package = pytest.importorskip("mujoco_playground")
    env = package.wrapper.wrap_for_brax_training(
        limp, episode_length=LIMIT, full_reset=full
    )
    start = jax.jit(env.reset)(raw_keys(8))
    state, (obs, done, _) = roll(env.step, start)
    assert np.all(np.max(done, axis=0) == 1)
    assert np.all(state.info["AutoResetWrapper_done_count"] >= 1)
    lane = int(np.argmax(done[-1]))
    assert np.array_equal(obs[-1, lane], start.obs[lane]) != full
