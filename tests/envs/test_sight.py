"""What a policy sees of the spheres, how many there are, and the curriculum."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import envs
from envs import sight
from envs.cli import make_config
from envs.spheres import LEVEL_STEP, Course, draw_count, draw_speed
from envs.types import ARM_ENTRIES
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.training.evaluation.evaluate import run_episodes
from rmp_mjx.training.learning import rollout
from rmp_mjx.training.runs import run_folder
from rmp_mjx.training.runs.checkpoint import CheckpointMismatch
from rmp_mjx.training.runs.loop import train
from rmp_mjx.training.runs.policies import load_agent
from tests.envs.arm_tasks import LANES, Torques

SLOTS, POINTS = 4, 6
COUNTS = (1, 2, 4, 6)
"""Spheres that are seen: fewer than there are, all, more."""
OPTIONS = {
    "physics": "mujoco",
    "obstacles": 4,
    "layout": "close",
    "obstacle_speed": 0.2,
    "seen_spheres": 2,
}
EVERY = {
    "obstacle_count": "random",
    "obstacle_motion": "sometimes",
    "obstacle_curriculum": True,
}
"""All that makes worlds random."""


@pytest.fixture(scope="module")
def look():
    """`look(count, world)`: `sight.look`, compiled once for each count."""

    def seen(count, world):
        spheres = Obstacles.empty(spheres=SLOTS).with_spheres(
            world.centers, world.radii, world.velocities
        )
        spheres = spheres.spheres.replace(active=jnp.asarray(world.active))
        site = SimpleNamespace(p=jnp.asarray(world.p), v=jnp.asarray(world.v))
        points, radii = jnp.asarray(world.points), jnp.asarray(world.rho)
        return sight.look(count, site, spheres, points, radii)  # pyright: ignore[reportArgumentType]

    run = jax.jit(
        lambda count, fields: seen(count, SimpleNamespace(**fields)), static_argnums=0
    )
    return lambda count, world: jax.device_get(run(count, vars(world)))


def draw(seed, active):
    """A random world about the size of the workspace."""
    rng = np.random.default_rng(seed)
    box = lambda *shape: rng.uniform(-0.6, 0.6, shape).astype(np.float32)  # noqa: E731
    return SimpleNamespace(
        p=box(3),
        v=box(3),
        centers=box(SLOTS, 3),
        velocities=box(SLOTS, 3),
        radii=rng.uniform(0.02, 0.1, SLOTS).astype(np.float32),
        points=box(POINTS, 3),
        rho=rng.uniform(0.02, 0.05, POINTS).astype(np.float32),
        active=np.asarray(active),
    )


worlds = st.builds(
    draw,
    st.integers(0, 2**31),
    st.lists(st.booleans(), min_size=SLOTS, max_size=SLOTS),
)


def in_numpy(count, world):
    """The definition, in float64 loops."""
    rows, gaps = [], []
    for k in np.flatnonzero(world.active):
        way = world.centers[k].astype(float) - world.p
        d = np.linalg.norm(way)
        w = np.exp(-d / 0.15)
        relative = world.velocities[k].astype(float) - world.v
        rows.append((d, np.r_[w * way / d, w, w * relative]))
        apart = np.linalg.norm(world.points.astype(float) - world.centers[k], axis=1)
        gaps.append(np.min(apart - world.rho) - world.radii[k])
    rows = [row for _, row in sorted(rows, key=lambda pair: pair[0])[:count]]
    table = np.zeros((count, 7))
    if rows:
        table[: len(rows)] = rows
    tightness = np.exp(-max(min(gaps), 0.0) / 0.05) if gaps else 0.0
    return table[:, :3], table[:, 3], table[:, 4:], tightness


@pytest.mark.parametrize("count", COUNTS)
@settings(max_examples=40, deadline=None)
@given(world=worlds)
def test_what_is_seen_is_its_definition(look, count, world):
    """1e-5 absolute: float32 values up to 1."""
    seen, names = look(count, world), [entry.name for entry in sight.entries(count)]
    for name, expected in zip(names, in_numpy(count, world), strict=True):
        np.testing.assert_allclose(seen[name], expected, atol=1e-5)


@settings(max_examples=40, deadline=None)
@given(world=worlds, order=st.permutations(range(SLOTS)))
def test_the_order_of_the_spheres_does_not_matter(look, world, order):
    order = np.array(order)
    moved = SimpleNamespace(**vars(world))
    for name in ("centers", "velocities", "radii", "active"):
        setattr(moved, name, getattr(world, name)[order])
    for name, value in look(2, world).items():
        np.testing.assert_array_equal(value, look(2, moved)[name])


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_nothing_is_seen_without_spheres(look, seed):
    for value in look(2, draw(seed, [False] * SLOTS)).values():
        assert not np.any(value)


def test_entries_fit_the_values(look):
    assert sight.entries(0) == ()
    for count in COUNTS:
        values = look(count, draw(0, [True] * SLOTS))
        assert {e.name: e.size for e in sight.entries(count)} == {
            name: np.size(value) for name, value in values.items()
        }


@pytest.mark.parametrize("task", envs.names())
def test_by_default_a_policy_sees_what_it_always_saw(task):
    """The paper's protocol: no entry, no draw and no key of `info` is new."""
    env = envs.load(task, physics="mujoco", obstacles=2)
    assert env.entries == ARM_ENTRIES + env.task_entries
    seeing = envs.load(task, physics="mujoco", obstacles=2, seen_spheres=3)
    assert seeing.entries == env.entries + sight.entries(3)
    assert seeing.observation_size == env.observation_size + 22
    key = jax.random.key(0)
    old, new = (jax.jit(e.reset)(key) for e in (env, seeing))
    np.testing.assert_array_equal(old.obs, new.obs[: env.observation_size])
    assert "course" not in old.info
    assert "obstacle_level" not in env.metrics


def test_default_worlds_are_those_of_earlier_versions():
    """Spheres of version 0.2.0, recorded; to 1e-6: another XLA may round otherwise."""
    options = {"obstacles": 2, "layout": "close", "obstacle_speed": 0.1}
    env = envs.load("trajectory", physics="mujoco", **options)
    state = jax.jit(env.reset)(jax.random.key(0))
    np.testing.assert_allclose(state.data.mocap_pos, RECORDED[:2], atol=1e-6)
    np.testing.assert_allclose(state.info["spheres"].velocity, RECORDED[2:], atol=1e-6)


RECORDED = np.array(
    [
        [0.3523854, -0.19640584, 0.23371482],
        [0.38238257, -0.10538621, 0.09883571],
        [-0.05808604, 0.03469666, -0.07363527],
        [-0.00798283, -0.08864128, -0.04559606],
    ]
)
"""Centres [m], then velocities [m/s]."""


def test_the_policy_sees_what_the_controller_gets_in_the_next_step(make):
    """Late and noisy, with the same error."""
    told = {"obstacle_delay": 0.1, "obstacle_noise": 0.02, "obstacle_speed": 0.3}
    task = make("torques", obstacles=3, layout="close", seen_spheres=3, **told)
    state = task.reset(jax.random.split(jax.random.key(2), LANES))
    state = task.step(state, jnp.zeros((LANES, 12)))
    env, lane = task.env, jax.tree.map(lambda x: x[0], state)
    spheres, (_, key) = lane.info["spheres"], jax.random.split(lane.info["rng"])
    error = 0.02 * jax.random.normal(key, (3, 3))
    told = env.obstacles(lane.data, spheres, error).spheres.center
    way = np.asarray(told - env.site(lane.data).p)
    way = way[np.argsort(np.linalg.norm(way, axis=1))]
    distance = np.linalg.norm(way, axis=1)
    start = env.observation_size - sum(e.size for e in sight.entries(3))
    expected = np.exp(-distance / 0.15)[:, None] * way / distance[:, None]
    seen = lane.obs[start : start + 9].reshape(3, 3)
    np.testing.assert_allclose(seen, expected, atol=1e-5)
    tight = lane.obs[-1]
    exact = np.exp(-max(float(env.clearance(lane.data, spheres)), 0.0) / 0.05)
    assert 0.0 < tight <= 1.0 and tight != pytest.approx(exact, abs=1e-6)


def test_the_number_and_the_speed_of_the_spheres_are_drawn():
    keys = jax.random.split(jax.random.key(0), 20_000)
    wanted = jax.vmap(lambda k: draw_count(k, 4, True))(keys)
    count = np.bincount(np.sum(wanted, axis=1), minlength=5)
    # 20,000 draws: 4 sigma of a share of 0.2 are 0.011
    np.testing.assert_allclose(count / 20_000, 0.2, atol=0.012)
    assert np.all(np.diff(wanted.astype(int), axis=1) <= 0)  # the first slots
    assert np.all(draw_count(keys[0], 4, False))
    half = jax.vmap(lambda k: draw_count(k, 4, True, 0.5))(keys)
    assert np.sum(half, axis=1).max() == 2
    speed = np.asarray(jax.vmap(lambda k: draw_speed(k, 0.2, False))(keys))
    assert np.mean(speed == 0.0) == pytest.approx(0.5, abs=0.015)
    moving = speed[speed > 0.0]
    assert moving.max() <= 0.2 and moving.mean() == pytest.approx(0.1, abs=0.003)
    assert draw_speed(keys[0], 0.2, True) == 0.2


@pytest.fixture(scope="module")
def random_worlds():
    """A task with a random number of spheres, and 1,000 starts."""
    env = envs.load("trajectory", controller=Torques(jnp.zeros(7)), **OPTIONS, **EVERY)
    starts = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(3), 1000))
    return env, starts


def test_a_slot_that_is_not_used_is_no_sphere_without_a_place(random_worlds):
    _, starts = random_worlds
    spheres = starts.info["spheres"]
    placed, missing = np.asarray(spheres.placed), np.asarray(spheres.missing)
    there = placed.sum(axis=1) + missing
    np.testing.assert_allclose(np.bincount(there) / 1000, 0.2, atol=0.06)
    assert np.mean(missing > 0) < 0.05
    assert np.all(np.asarray(starts.data.mocap_pos)[~placed] == [0.0, 0.0, -5.0])
    speed = np.linalg.norm(spheres.velocity, axis=-1)
    assert not speed[~placed].any()
    # One speed for all of an episode.
    fastest = speed.max(axis=1, keepdims=True)
    np.testing.assert_allclose(np.where(placed, fastest, 0.0), speed, atol=1e-6)


def test_with_random_worlds_nothing_else_about_a_start_changes(random_worlds):
    """Its via points, its pose and the places of its spheres are the fixed ones'."""
    env, starts = random_worlds
    fixed = envs.load("trajectory", controller=env.controller, **OPTIONS)
    others = jax.jit(jax.vmap(fixed.reset))(jax.random.split(jax.random.key(3), 1000))
    np.testing.assert_array_equal(starts.data.qpos, others.data.qpos)
    np.testing.assert_array_equal(starts.task["points"], others.task["points"])
    placed = np.asarray(starts.info["spheres"].placed)
    assert not np.any(placed & ~np.asarray(others.info["spheres"].placed))
    mine, theirs = (np.asarray(s.data.mocap_pos)[placed] for s in (starts, others))
    np.testing.assert_array_equal(mine, theirs)


def test_the_curriculum_rises_after_success_and_falls_after_an_event():
    yes, no = jnp.bool_(True), jnp.bool_(False)
    start = Course.at(0.5)
    assert float(start.then(yes, no).then(no, no).following().level) == pytest.approx(
        0.5 + LEVEL_STEP
    )
    for harmed in (start.then(no, yes), start.then(yes, no).then(no, yes)):
        assert float(harmed.following().level) == pytest.approx(0.5 - LEVEL_STEP)
    assert float(start.then(no, no).following().level) == 0.5
    assert float(Course.at(1.0).then(yes, no).following().level) == 1.0
    assert float(Course.at(0.0).then(no, yes).following().level) == 0.0
    assert not start.then(yes, yes).following().harmed


def test_an_environment_restarts_at_its_level(random_worlds):
    env, starts = random_worlds
    keys = jax.random.split(jax.random.key(4), 1000)
    first = jax.jit(jax.vmap(lambda k: env.restart(k, None)))(keys)
    assert not np.any(first.info["spheres"].placed)
    level = jnp.arange(1000) % 11 / 10.0
    course = jax.vmap(lambda x: Course.at(x).then(jnp.bool_(False), jnp.bool_(False)))
    ended = starts.replace(info=starts.info | {"course": course(level)})
    after = jax.jit(jax.vmap(env.restart))(keys, ended)
    np.testing.assert_allclose(after.info["course"].level, level, atol=1e-6)
    placed = np.sum(after.info["spheres"].placed, axis=1)
    assert np.all(placed <= np.round(4 * np.asarray(level)))
    speed = np.linalg.norm(after.info["spheres"].velocity, axis=-1).max(axis=1)
    assert np.all(speed <= 0.2 * np.asarray(level) + 1e-6)
    for number in (0, 10):
        assert placed[np.asarray(level * 10).round() == number].max() == 4 * number / 10
    # Evaluation has the whole world: `reset` is at the end of the curriculum.
    assert np.all(np.asarray(starts.info["course"].level) == 1.0)


def test_training_carries_the_level_from_episode_to_episode():
    """Lanes that fall on the table lose a level; those that hold still keep theirs."""
    options = OPTIONS | {"episode_length": 6, "start_noise": 0.0}
    env = envs.load("trajectory", controller=Torques(jnp.zeros(7)), **options, **EVERY)

    def act(obs, keys):
        fall = jnp.zeros((len(obs), 12))
        return fall, {"raw_action": fall, "log_prob": jnp.zeros(len(obs))}

    @jax.jit
    def run(keys):
        state = rollout.init(env, keys)
        high = jax.vmap(Course.at)(jnp.full(LANES, 0.5))
        inner = state.env_state
        inner = inner.replace(info=inner.info | {"course": high})
        state = state.replace(env_state=inner)
        return rollout.unroll(env, act, state, keys, 12)

    state, data, stats = run(jax.random.split(jax.random.key(0), LANES))
    hit = np.asarray(data.termination)
    level = np.asarray(state.env_state.info["course"].level)
    np.testing.assert_allclose(level, 0.5 - LEVEL_STEP * hit.sum(axis=0), atol=1e-6)
    assert hit.sum() > 0
    assert "obstacle_level" in stats.episode_sums


TINY = {
    "num_envs": 4,
    "unroll_length": 2,
    "num_minibatches": 1,
    "num_updates_per_batch": 1,
    "hidden_sizes": (4,),
    "num_timesteps": 8,
    "eval_episodes": 0,
    "video": False,
}


@pytest.mark.parametrize("task", envs.names())
@pytest.mark.parametrize("controller", ["rmp_vices", "vices", "vices_cbf"])
def test_every_task_and_controller_takes_the_options(task, controller):
    """Traced only: a step keeps the structure of the state, with or without spheres."""
    for obstacles in (0, 3):
        options: dict[str, Any] = OPTIONS | EVERY | {"obstacles": obstacles}
        env = envs.load(task, controller=controller, **options)
        start = jax.eval_shape(env.reset, jax.random.key(0))
        again = jax.eval_shape(env.restart, jax.random.key(0), start)
        after = jax.eval_shape(env.step, start, jnp.zeros(env.action_size))
        layout = [
            jax.tree.map(lambda x: (x.shape, x.dtype), s) for s in (start, again, after)
        ]
        assert layout[0] == layout[1] == layout[2]
        assert start.obs.shape == (env.observation_size,)
        assert set(start.metrics) == set(env.metrics) >= {"obstacle_level"}


@pytest.mark.slow
def test_a_policy_that_sees_is_trained_loaded_and_run_in_other_worlds(tmp_path):
    """Trained among 0 to 4 moving spheres; evaluated among none and among six."""
    run = {"episode_length": 3, "run_dir": str(tmp_path / "run")}
    config = make_config(**TINY, **OPTIONS, **EVERY, **run)
    controller = Torques(jnp.zeros(7))
    folder, lock = run_folder.open_run(config)
    with lock:
        train(envs.make(config.task, controller=controller), config, folder)
    for number in (0, 6):
        task = config.replace(obstacles=number, obstacle_count="fixed").task
        env = envs.make(task, controller=controller)
        _, agent = load_agent(env, config, folder, True, pytest.fail)
        results = run_episodes(env, agent, 2, jax.random.key(0))
        assert not results["lost"].any()
        assert np.all(results["obstacle_level"] == 1.0)
    blind = envs.make(config.replace(seen_spheres=0).task, controller=controller)
    with pytest.raises(CheckpointMismatch):
        load_agent(blind, config, folder, True, pytest.fail)
