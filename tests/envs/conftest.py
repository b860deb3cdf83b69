"""Tasks compiled once, and the same physics in MuJoCo C to check them against."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from rmp_mjx.robot import Robot
from tests.envs.arm_tasks import LANES, Arm, Torques, first


@pytest.fixture(scope="session")
def make():
    """`make(controller, task, **options)`: env, vmapped reset and step, compiled."""

    @functools.cache
    def build(controller, task="trajectory", **options):
        if controller == "torques":
            robot = Robot.load("jaco2")
            data = mujoco.MjData(robot.mj_model)
            data.qpos[:] = robot.q_home
            mujoco.mj_forward(robot.mj_model, data)
            controller = Torques(np.asarray(data.qfrc_bias, np.float32))
            if "observer" in options:
                controller = controller.replace(robot=robot)
        options = {"physics": "mujoco", "obstacles": 2} | options
        env = envs.load(task, controller=controller, **options)
        return SimpleNamespace(
            env=env,
            reset=jax.jit(jax.vmap(env.reset)),
            step=jax.jit(jax.vmap(env.step)),
        )

    return build


@pytest.fixture(scope="session")
def far(make):
    """Default options, two spheres; 1,000 starts."""
    task = make("torques")
    task.starts = task.reset(jax.random.split(jax.random.key(0), 1000))
    return task


@pytest.fixture(scope="session")
def close(make):
    """Every option that is not the default; 1,000 starts."""
    task = make(
        "torques",
        layout="close",
        observation="fixed",
        event_penalty=7.0,
        terminate_on_event=False,
        terminate_on_success=False,
    )
    task.starts = task.reset(jax.random.split(jax.random.key(1), 1000))
    return task


@pytest.fixture(scope="session")
def quiet(far):
    """Eight starts at the home pose, spheres and via points out of the way."""
    state = first(far.starts)
    q = jnp.tile(far.env.robot.q_home.astype(np.float32), (LANES, 1))
    away = jnp.broadcast_to(jnp.array([0.0, 0.0, -5.0]), state.data.mocap_pos.shape)
    data = state.data.replace(qpos=q, qvel=0 * q, mocap_pos=away)
    points = jnp.array(
        [[0.3, 0.2, 0.2], [0.5, 0.2, 0.2], [0.5, -0.2, 0.2], [0.3, 0, 0.3]]
    )
    task = state.task | {"points": jnp.tile(points, (LANES, 1, 1))}
    info = state.info | {"task": task}
    return state.replace(data=data, info=info)


@pytest.fixture(scope="session")
def arm(far):
    return Arm(far.env.scene.model)
