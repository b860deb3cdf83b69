"""An arm from someone else's file, with position actuators, in a task."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from rmp_mjx import Robot


@pytest.fixture(scope="module")
def robot():
    """The Jaco 2, with motors."""
    return Robot.load("jaco2")


@pytest.fixture(scope="module")
def servos(robot):
    """The Jaco 2 with position actuators, limits only in their force ranges."""
    text = robot.mjcf
    for k, limit in enumerate(robot.tau_max, 1):
        size = "large" if limit > 10 else "small"
        motor = f'<general name="joint_{k}" class="{size}" joint="joint_{k}"/>'
        assert motor in text
        text = text.replace(
            motor,
            f'<position name="joint_{k}" joint="joint_{k}" kp="200" kv="20" '
            f'forcerange="-{limit} {limit}"/>',
        )
    # Without the ranges of the classes, which are torques.
    text = text.replace('<general ctrlrange="-30.5 30.5"/>', "")
    text = text.replace('<general ctrlrange="-6.8 6.8"/>', "")
    return Robot.from_mjcf(
        text, site="grip", q_home=robot.q_home, compensate_passive=False
    )


def test_an_arm_with_position_actuators_is_the_arm_with_motors(robot, servos):
    """The same to the last bit, but for its text."""
    assert servos.replace(mjcf=robot.mjcf) == robot


def test_a_position_actuated_arm_holds_still_in_a_task(servos):
    """One second of the zero action; torques taken for positions gave 1.3 rad."""
    env = envs.load("trajectory", robot=servos, physics="mujoco", start_noise=0.0)
    state, step = jax.jit(env.reset)(jax.random.key(0)), jax.jit(env.step)
    start = state.data.qpos
    for _ in range(20):
        state = step(state, jnp.zeros(env.action_size))
    np.testing.assert_allclose(state.data.qpos, start, rtol=0.0, atol=1e-3)
