"""The trajectory task's score and observation, recomputed in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.envs.arm_tasks import LANES, first

REST = jnp.zeros((LANES, 12))


def with_task(state, **values):
    values = {name: jnp.asarray(value) for name, value in values.items()}
    return state.replace(info=state.info | {"task": state.task | values})


def points_at(arm, state, which, distance):
    """Via points of which the given ones are `distance` from the grip, sideways."""
    points = np.array(state.task["points"])
    grip = arm.site(np.asarray(state.data.qpos[0]))[0]
    points[:, which] = grip + np.array([0.0, distance, 0.0])
    return with_task(state, points=points)


@pytest.fixture(scope="module")
def moving(far):
    """A random state on its way, and where a random action leads."""
    state = first(far.starts)
    keys = jax.random.split(jax.random.key(3), 2)
    qd = 0.2 * jax.random.normal(keys[0], state.data.qvel.shape)
    state = state.replace(data=state.data.replace(qvel=qd))
    state = with_task(state, reached=np.arange(LANES) % 4)
    action = jax.random.uniform(keys[1], (LANES, 12), minval=-1.0, maxval=1.0)
    return state, action, far.step(state, action)


def test_stepping_keeps_the_structure_of_the_state(far, moving):
    before, _, after = moving
    assert jax.tree.structure(before) == jax.tree.structure(after)
    shapes = [jax.tree.map(lambda x: (x.shape, x.dtype), s) for s in (before, after)]
    assert shapes[0] == shapes[1]
    assert after.metrics.keys() == far.env.metrics.keys()
    assert after.obs.shape == (LANES, far.env.observation_size)
    for x in (after.reward, after.done, *after.metrics.values()):
        assert x.shape == (LANES,) and x.dtype == jnp.float32


def test_a_batch_is_a_loop_over_its_lanes(far, moving):
    """Within 1e-4 of the values: XLA orders float32 sums by the batch's shape."""
    state, action, batched = moving
    one = jax.jit(far.env.step)
    for lane in (0, 3):
        alone = one(jax.tree.map(lambda x, i=lane: x[i], state), action[lane])
        lanes = jax.tree.map(lambda x, i=lane: x[i], batched)
        for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(lanes), strict=True):
            if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
                a, b = jax.random.key_data(a), jax.random.key_data(b)
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)


def expected_reward(env, arm, before, after, lane):
    """The docstring's formula, from the two states alone."""
    reached = int(before.task["reached"][lane])
    if reached == 4:
        return 0.0, 4
    target = np.asarray(before.task["points"][lane, reached], float)
    d = np.linalg.norm(target - arm.site(np.asarray(after.data.qpos[lane]))[0])
    if d >= 0.05:
        return 30 * (1 - np.tanh(5 * d)), reached
    bonus = 25 * (1024 - int(after.info["step"][lane])) if reached == 3 else 0.0
    return 100.0 + bonus, reached + 1


def test_reward_is_the_formula(far, arm, moving):
    """Relative 1e-5: float32 forward kinematics against MuJoCo's float64."""
    state, _, after = moving
    for lane in range(LANES):
        reward, reached = expected_reward(far.env, arm, state, after, lane)
        cost = 50.0 if event(after, lane) else 0.0
        assert after.reward[lane] == pytest.approx(reward - cost, rel=1e-5, abs=1e-3)
        assert int(after.task["reached"][lane]) == reached


def event(state, lane):
    names = ("collision", "self_collision", "joint_limit")
    return any(float(state.metrics[n][lane]) > 0 for n in names)


@pytest.mark.parametrize("which", ["far", "close"])
def test_observation_is_the_formula(which, request, arm):
    """`rotated`: vectors from the grip, current point first; `fixed`: the paper's.

    Absolute 2e-5 (m, m/s): float32 kinematics.
    """
    task = request.getfixturevalue(which)
    state = with_task(first(task.starts), reached=np.arange(LANES) % 5)
    action = 0.3 * jnp.ones((LANES, 12))
    after = task.step(state, action)
    for lane in range(LANES):
        q, qd = (np.asarray(x[lane]) for x in (after.data.qpos, after.data.qvel))
        p, R, v, w = arm.site(q, qd)
        points = np.asarray(after.task["points"][lane], float)
        k = int(after.task["reached"][lane])
        flags = (np.arange(4) < k).astype(float)
        if which == "far":
            points, flags = np.roll(points - p, -k, axis=0), np.roll(flags, -k)
        expected = np.concatenate([p, R.ravel(), v, w, points.ravel(), flags])
        np.testing.assert_allclose(after.obs[lane], expected, atol=2e-5)


def test_points_count_in_their_order_only(far, arm, quiet):
    """The grip is on the third point: nothing, until the first two are reached."""
    state = points_at(arm, quiet, [2], 0.01)
    state = with_task(state, reached=np.array([0, 1, 2, 3, 4, 0, 1, 2]))
    after = far.step(state, REST)
    np.testing.assert_array_equal(after.metrics["via_points"], [0, 0, 1, 0, 0, 0, 0, 1])
    np.testing.assert_array_equal(after.task["reached"], [0, 1, 3, 3, 4, 0, 1, 3])
    np.testing.assert_allclose(np.asarray(after.reward)[[2, 7]], 100.0)
    assert after.reward[4] == 0.0  # after the last point there is nothing to earn


def test_a_point_is_reached_within_five_centimetres(far, arm, quiet):
    inside = far.step(points_at(arm, quiet, [0], 0.049), REST)
    outside = far.step(points_at(arm, quiet, [0], 0.051), REST)
    assert np.all(inside.metrics["via_points"] == 1)
    assert np.all(outside.metrics["via_points"] == 0)


def test_points_on_one_spot_are_reached_one_a_step(far, arm, quiet):
    state = points_at(arm, quiet, slice(None), 0.0)
    for count in range(1, 5):
        state = far.step(state, REST)
        assert np.all(state.task["reached"] == count)
        assert np.all(state.metrics["success"] == (count == 4))


def test_finishing_pays_for_the_steps_left_and_ends_the_episode(far, arm, quiet):
    state = points_at(arm, quiet, [3], 0.0)
    state = with_task(state, reached=np.full(LANES, 3))
    state = state.replace(info=state.info | {"step": jnp.arange(LANES) * 100})
    after = far.step(state, REST)
    left = 1024 - (np.arange(LANES) * 100 + 1)
    np.testing.assert_allclose(after.reward, 100 + 25 * left)
    assert np.all(after.done == 1) and np.all(after.metrics["success"] == 1)


def test_finishing_need_not_end_the_episode(close, arm, quiet):
    state = with_task(points_at(arm, quiet, [3], 0.0), reached=np.full(LANES, 3))
    state = close.step(state, REST)
    assert np.all(state.done == 0) and np.all(state.metrics["success"] == 1)
    state = close.step(state, REST)
    assert np.all(state.reward == 0) and np.all(state.metrics["success"] == 0)


def test_starts_scatter_about_the_home_pose(far):
    """Standard deviation 0.02 rad within 5 %: 7,000 draws scatter by 0.9 %."""
    offset = np.asarray(far.starts.data.qpos) - far.env.robot.q_home
    assert np.std(offset) == pytest.approx(0.02, rel=0.05)
    assert np.abs(np.mean(offset)) < 0.001
    assert not np.any(far.starts.data.qvel) and not np.any(far.starts.done)


def test_saturation_is_the_share_of_physics_steps_at_a_limit(far, quiet):
    """The toy controller reports a torque limit where its sixth torque is positive."""
    after = far.step(quiet, REST.at[3, 5].set(0.1))
    expected = np.eye(LANES)[3]
    np.testing.assert_allclose(after.metrics["torque_saturation"], expected, rtol=1e-6)


def test_tracking_error_is_the_distance_to_the_set_point(far, arm, quiet):
    after = far.step(quiet, REST)  # the toy controller's set-point is the base
    grip = arm.site(np.asarray(after.data.qpos[0]))[0]
    error = np.linalg.norm(grip)
    np.testing.assert_allclose(after.metrics["tracking_error"], error, rtol=1e-5)


@pytest.mark.parametrize(
    ("field", "value"), [("qpos", np.nan), ("qvel", np.inf), ("qvel", 1e6)]
)
def test_a_state_that_is_not_finite_ends_its_episode_alone(far, quiet, field, value):
    clean = far.step(quiet, REST)
    spoilt = getattr(quiet.data, field).at[2, 1].set(value)
    state = quiet.replace(data=quiet.data.replace(**{field: spoilt}))
    after = far.step(state, REST)
    assert after.done[2] == 1 and after.reward[2] == 0
    assert after.metrics["nonfinite"][2] == 1
    for x in (after.obs, after.reward, *after.metrics.values()):
        assert np.all(np.isfinite(x))
    rest = np.arange(LANES) != 2
    np.testing.assert_array_equal(after.obs[rest], clean.obs[rest])
    assert not np.any(np.asarray(after.done)[rest])
    assert not np.any(np.asarray(after.metrics["nonfinite"])[rest])
