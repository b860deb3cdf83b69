"""An environment says which arm it has; a run of one arm is no run of another."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.cli import make_config
from rmp_mjx import RMPVICES, Robot
from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.runs import run_folder
from rmp_mjx.training.runs.loop import train
from rmp_mjx.training.runs.policies import load_agent

LINK = """
<body name="b{k}" pos="0 0 {length}">
  <joint name="j{k}" axis="{axis}" range="-2 2" limited="true"/>
  <geom name="g{k}" type="capsule" fromto="0 0 0 0 0 0.2" size="0.03" mass="1"/>
  {rest}
</body>"""
TINY = {
    "controller": "osc",
    "num_envs": 2,
    "unroll_length": 2,
    "num_minibatches": 1,
    "num_updates_per_batch": 1,
    "hidden_sizes": (4,),
    "num_timesteps": 4,
}


@pytest.fixture(scope="module")
def arm():
    """Three hinges and a site."""
    rest = '<site name="tip" pos="0 0 0.2"/>'
    for k, axis in ((3, "0 1 0"), (2, "1 0 0"), (1, "0 0 1")):
        length = 0.2 if k > 1 else 0.0
        rest = LINK.format(k=k, axis=axis, length=length, rest=rest)
    motors = "".join(
        f'<motor joint="j{k}" ctrlrange="-20 20" ctrllimited="true"/>'
        for k in (1, 2, 3)
    )
    return Robot.from_mjcf(
        f'<mujoco model="tiny"><compiler angle="radian"/><worldbody>{rest}</worldbody>'
        f"<actuator>{motors}</actuator></mujoco>",
        site="tip",
    )


def test_the_jaco_is_one_arm_in_every_task_and_with_every_option():
    jaco = f"'jaco2' (fingerprint {Robot.load('jaco2').fingerprint[:12]})"
    for env in (
        envs.load("trajectory"),
        envs.load("door", armature="robosuite", controller="vices"),
    ):
        assert env.identity == {"arm": jaco}


def test_an_arm_and_a_controller_of_your_own_are_named(arm):
    env = envs.load("trajectory", robot=arm, controller=RMPVICES(arm))
    assert env.identity == {
        "arm": f"'tiny' (fingerprint {arm.fingerprint[:12]})",
        "controller": "'RMPVICES' of your own",
    }


def test_a_run_of_a_tiny_arm_is_refused_for_the_jaco(arm, tmp_path):
    env = envs.load("trajectory", robot=arm, controller="osc", physics="mujoco")
    folder = tmp_path / "run"
    config = make_config(**TINY, run_dir=str(folder))
    _, lock = run_folder.open_run(config)
    with lock:
        train(env, config, folder)
    assert load_agent(env, config, folder, True, pytest.fail)[0] == 1
    message = (
        rf"the arm 'tiny' \(fingerprint {arm.fingerprint[:12]}\), not with 'jaco2'"
    )
    with pytest.raises(ConfigError, match=message):
        load_agent(envs.make(config.task), config, folder, True, pytest.fail)


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
