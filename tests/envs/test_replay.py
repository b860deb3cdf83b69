"""Replaying a written step in MuJoCo C."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs import replay
from envs.cli import make_config
from rmp_mjx.training.learning import faults
from rmp_mjx.training.runs import run_folder

CONFIG = make_config(
    controller="vices",
    physics="mujoco",
    obstacles=1,
    obstacle_speed=0.1,
    obstacle_noise=0.01,
)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """`written(change)`: file of a batch's second lane, the state changed before."""
    env = envs.make(CONFIG.task)
    start = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 3))
    action = 0.3 * jnp.ones((3, env.action_size))
    folder = tmp_path_factory.mktemp("dumps")
    about = {"config": CONFIG.record(), "iteration": 3, "seed": 0}

    def write(name, change=lambda state, action: (state, action)):
        happened = jnp.array([False, True, False])
        fault = faults.Fault(happened, *change(start, action))
        (path,) = faults.dump(fault, folder, name, about, 9)
        return path

    return write


def spin(speed):
    def change(state, action):
        qvel = state.data.qvel.at[:, 4].set(speed)
        return state.replace(data=state.data.replace(qvel=qvel)), action

    return change


def test_a_healthy_step_is_replayed_as_the_task_takes_it(written, capsys):
    path = written("healthy")
    env, state, action, about = replay.read(path)
    assert (about["lane"], about["iteration"]) == (1, 3)
    moments = []
    assert (
        replay.first_bad(replay.policy_step(env, state, action), 1e6, moments) is None
    )
    new = jax.jit(env.step)(state, action)
    # the same engine on states that are rounded to float32 after every physics step;
    # the controller is compiled by itself here
    last = moments[-2].values
    np.testing.assert_allclose(last["position"], new.data.qpos, atol=1e-5)
    np.testing.assert_allclose(last["speed"], new.data.qvel, atol=1e-3)
    assert len(moments) == 3 + 2 * env.n_substeps

    assert replay.main([str(path)]) == 0
    assert "every number is finite" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("fast", spin(1e5), "first bad number: speed[4] = 100000, before"),
        ("unstable", spin(950.0), "first bad number: "),
        (
            "policy",
            lambda state, action: (state, action.at[:, 7].set(jnp.nan)),
            "first bad number: action[7] = nan, before",
        ),
    ],
)
def test_the_first_bad_number_is_named(written, capsys, name, change, said):
    assert replay.main([str(written(name, change))]) == 0
    out = capsys.readouterr().out
    assert said in out
    assert "trajectory, iteration 3, seed 0, lane 1" in out


def test_of_a_run_the_earliest_step_is_taken(written, tmp_path):
    folder = tmp_path / run_folder.NONFINITE
    folder.mkdir()
    with pytest.raises(ValueError, match="has no non-finite steps"):
        replay.choose(tmp_path)
    for iteration in (20, 3):
        about = {"iteration": iteration, "config": {}}
        name = folder / f"iteration{iteration}.npz"
        np.savez(name, about=np.array(json.dumps(about)))
    assert replay.choose(tmp_path) == folder / "iteration3.npz"
    assert replay.choose(folder / "iteration20.npz") == folder / "iteration20.npz"


def test_a_file_of_something_else_is_refused(tmp_path, capsys):
    np.savez(tmp_path / "x.npz", x=np.zeros(3))
    assert replay.main([str(tmp_path / "x.npz")]) == 2
    assert "is no dump" in capsys.readouterr().err
