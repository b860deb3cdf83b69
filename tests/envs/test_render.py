"""Frames of recorded states, where this machine can render at all."""

import jax
import numpy as np
import pytest

import envs
from rmp_mjx import runtime

SIZE = (120, 160)


@pytest.fixture(scope="module")
def draw():
    """Frames of a task's start, and of the same with some of its state changed."""
    if runtime.choose_gl() is None:
        pytest.skip("no headless rendering on this machine")
    from envs.render import render

    def frames(name, *changes, **options):
        env = envs.load(name, physics="mujoco", **options)
        start = jax.device_get(jax.jit(env.reset)(jax.random.key(0)))
        return render(env, [start, *(change(start) for change in changes)], SIZE)

    return frames


@pytest.mark.parametrize("name", envs.names())
def test_every_task_can_be_drawn(draw, name):
    (frame,) = draw(name, obstacles=2)
    assert frame.shape == (*SIZE, 3) and frame.dtype == np.uint8
    assert len(np.unique(frame.reshape(-1, 3), axis=0)) > 100


def reddish(frame):
    """Pixels of the spheres' colour."""
    r, g, b = np.moveaxis(frame.astype(int), -1, 0)
    return int(np.sum((r > 100) & (r > 2 * g) & (r > 2 * b)))


def greenish(frame):
    """Pixels of the colour of what is reached, or of a goal."""
    r, g, b = np.moveaxis(frame.astype(int), -1, 0)
    return int(np.sum((g > 1.3 * r) & (g > 1.3 * b)))


def test_the_spheres_are_where_the_state_says(draw):
    def away(state):
        far = np.full_like(state.data.mocap_pos, -5.0)
        return state.replace(data=state.data.replace(mocap_pos=far))

    with_spheres, without = draw("trajectory", away, obstacles=2)
    assert reddish(with_spheres) > 50
    assert reddish(without) == 0


def test_reached_points_change_their_colour(draw):
    def finished(state):
        return state.replace(
            info=state.info | {"task": state.task | {"reached": np.int32(4)}}
        )

    start, end = draw("trajectory", finished)
    assert greenish(start) == 0
    assert greenish(end) > 10


def test_the_goal_of_pushing_is_drawn(draw):
    def hidden(state):
        goal = np.full_like(state.task["goal"], 5.0)
        return state.replace(info=state.info | {"task": {"goal": goal}})

    shown, gone = draw("push", hidden)
    assert greenish(shown) > 10
    assert greenish(gone) == 0
