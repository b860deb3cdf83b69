"""Tasks as Gymnasium environments, where the extra `gym` is installed."""

import jax.numpy as jnp
import numpy as np
import pytest

import envs
from tests.envs.arm_tasks import Torques

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra `gym`")

from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402
from gymnasium.wrappers.vector import RecordEpisodeStatistics  # noqa: E402

from envs.gym import TaskEnv, TaskVector  # noqa: E402

LANES, LIMIT = 3, 4


@pytest.fixture(scope="module")
def task():
    controller = Torques(jnp.zeros(7))
    return envs.load(
        "trajectory", controller=controller, physics="mujoco", episode_length=LIMIT
    )


@pytest.fixture(scope="module")
def single(task):
    return TaskEnv(task)


@pytest.fixture(scope="module")
def vector(task):
    return TaskVector(task, LANES)


def still(env):
    return np.zeros(env.action_space.shape, np.float32)


@pytest.mark.filterwarnings("ignore:.*Box observation space (min|max)imum value")
@pytest.mark.filterwarnings("ignore:.*not within the observation space")
def test_gymnasiums_checker_accepts_it(single):
    check_env(single, skip_render_check=True)


def test_an_episode_is_truncated_at_the_time_limit_and_its_metrics_are_info(single):
    _, info = single.reset(seed=1)
    for k in range(1, LIMIT + 1):
        obs, reward, terminated, truncated, info = single.step(still(single))
        assert obs.dtype == np.float32 and isinstance(reward, float)
        if terminated:
            break
        assert truncated == (k == LIMIT)
    assert {"collision", "success", "clearance"} <= info.keys()


def test_a_step_before_a_reset_is_refused(task):
    for env in (TaskEnv(task), TaskVector(task, 2)):
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.step(still(env))


def test_spaces_and_types_are_those_of_a_vector(vector):
    obs, info = vector.reset(seed=0)
    assert vector.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert vector.observation_space.contains(obs) and info == {}
    vector.action_space.seed(0)
    obs, reward, terminated, truncated, info = vector.step(vector.action_space.sample())
    assert vector.observation_space.contains(obs)
    assert (reward.dtype, terminated.dtype, truncated.dtype) == (
        np.float64,
        np.bool_,
        np.bool_,
    )
    for x in (reward, terminated, truncated, info["collision"], info["_collision"]):
        assert x.shape == (LANES,)


def test_each_lane_is_the_single_environment_with_its_seed(single, vector):
    """Within 1e-4: XLA orders float32 sums by the batch's shape."""
    first, _ = vector.reset(seed=5)
    second, *_ = vector.step(still(vector))
    for lane in range(LANES):
        alone, _ = single.reset(seed=5 + lane)
        np.testing.assert_allclose(first[lane], alone, rtol=1e-4, atol=1e-4)
        alone, *_ = single.step(still(single))
        np.testing.assert_allclose(second[lane], alone, rtol=1e-4, atol=1e-4)
    listed, _ = vector.reset(seed=[5, 9, 7])
    np.testing.assert_array_equal(listed[[0, 2]], first[[0, 2]])
    with pytest.raises(ValueError, match="2 seeds for 3"):
        vector.reset(seed=[1, 2])


def test_one_that_ends_is_reset_in_the_same_step_and_hands_on_its_last_one(vector):
    start, _ = vector.reset(seed=2)
    ended = np.zeros(LANES, bool)
    for _ in range(LIMIT):
        obs, _, terminated, truncated, info = vector.step(still(vector))
        done = terminated | truncated
        if not done.any():
            continue
        np.testing.assert_array_equal(info["_final_obs"], done)
        for lane in np.flatnonzero(done):
            last = info["final_obs"][lane]
            assert last.shape == obs[lane].shape
            assert not np.array_equal(last, obs[lane])
            assert not np.array_equal(start[lane], obs[lane])  # a start of its own
            assert (
                info["final_info"]["_clearance"][lane] and not info["_clearance"][lane]
            )
        ended |= done
    assert ended.all()


def test_gymnasiums_wrappers_count_its_episodes(vector):
    counted = RecordEpisodeStatistics(vector)
    counted.reset(seed=3)
    lengths = []
    for _ in range(2 * LIMIT):
        *_, info = counted.step(still(vector))
        if "episode" in info:
            lengths += info["episode"]["l"][info["_episode"]].tolist()
    assert len(lengths) >= 2 * LANES
    assert max(lengths) == LIMIT


def test_stable_baselines_learns_from_it(task):
    """A few thousand steps, where Stable-Baselines3 is installed (it is no extra)."""
    baselines = pytest.importorskip(
        "stable_baselines3", reason="needs Stable-Baselines3 and torch"
    )
    model = baselines.PPO(
        "MlpPolicy", TaskEnv(task), n_steps=512, batch_size=128, n_epochs=2, seed=0
    )
    before = {k: v.clone() for k, v in model.policy.state_dict().items()}
    model.learn(2048)
    after = model.policy.state_dict()
    assert model.num_timesteps == 2048
    assert all(bool(v.isfinite().all()) for v in after.values())
    assert any(not bool((after[k] == before[k]).all()) for k in before)
