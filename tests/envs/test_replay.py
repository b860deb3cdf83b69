"""Replaying a written step in MuJoCo C."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs import export, replay
from envs.cli import make_config
from envs.flags import load_config
from rmp_mjx.training.learning import faults
from rmp_mjx.training.policy import load_policy
from rmp_mjx.training.runs import run_folder
from rmp_mjx.training.runs.policies import load_agent
from tests.envs import arm_tasks
from tests.training import toys
from tests.training.conftest import run

CONFIG = make_config(
    controller="vices",
    physics="mujoco",
    obstacles=1,
    obstacle_speed=0.1,
    obstacle_noise=0.01,
    observer="momentum",
    observer_noise=0.01,
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
        about = {"config": {}, "iteration": iteration, "seed": 0, "lane": 0}
        name = folder / f"iteration{iteration}.npz"
        np.savez(name, about=np.array(json.dumps(about)))
    assert replay.choose(tmp_path) == folder / "iteration3.npz"
    assert replay.choose(folder / "iteration20.npz") == folder / "iteration20.npz"


def test_a_file_of_something_else_is_refused(tmp_path, capsys):
    np.savez(tmp_path / "x.npz", x=np.zeros(3))
    assert replay.main([str(tmp_path / "x.npz")]) == 2
    assert "is no dump" in capsys.readouterr().err


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A finished run of two seeds."""
    folder = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        arm_tasks.register(patch)
        run(folder, num_seeds=2, seed=5)
        yield folder


@pytest.mark.parametrize("seed_index", [0, 1])
def test_an_exported_policy_acts_as_the_checkpoint(folder, tmp_path, seed_index):
    file = tmp_path / "toy.safetensors"
    options = [str(folder), "--out", str(file), "--seed_index", str(seed_index)]
    assert export.main([*options, "--checkpoint", "2"]) == 0
    obs, key = jax.random.normal(jax.random.key(0), (20, 3)), jax.random.key(1)
    config = load_config(folder)
    env, note = toys.Counter(), pytest.fail
    old = load_agent(env, config, folder, False, note, seed_index, "2")
    new = load_agent(env, config, file, False, note)
    assert old[0] == new[0] == 2
    np.testing.assert_array_equal(old[1](obs, key), new[1](obs, key))
    about = load_policy(file).about
    assert about["steps"] == 2 * config.ppo.steps_per_iteration
    own = load_config(file)
    assert (own.ppo.seed, own.ppo.num_seeds) == (5 + seed_index, 1)
    assert own.task == config.task
    assert "jax" in about["versions"]


@pytest.mark.parametrize(
    ("name", "more", "code", "message"),
    [
        ("toy.npz", [], 2, "NAME.safetensors"),
        ("there.safetensors", [], 2, "exists already"),
        ("no/toy.safetensors", [], 2, "there is no folder"),
        ("toy.safetensors", ["--seed_index", "2"], 2, "must lie in 0 .. 1"),
        ("toy.safetensors", ["--checkpoint", "3"], 1, "no checkpoint '3'"),
        ("toy.safetensors", ["--robot", "fr3"], 2, "leave robot and"),
        ("toy.safetensors", ["--guard_speed", "0"], 2, "guard_speed out"),
        ("toy.rmp", ["--guard_speed", "-1"], 2, "guard_speed must be finite"),
        ("toy.rmp", [], 2, "'counter' has no arm"),
        ("toy.rmp", ["--period", "0"], 2, "period must be in"),
        ("toy.rmp", ["--spheres", "-1"], 2, "spheres must be"),
    ],
)
def test_what_cannot_be_exported_is_said(
    folder, tmp_path, capsys, name, more, code, message
):
    (tmp_path / "there.safetensors").touch()
    args = [str(folder), "--out", str(tmp_path / name), *more]
    assert export.main(args) == code
    assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["there.safetensors"]
