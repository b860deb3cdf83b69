"""A checkpoint's policy as one file, on a toy task."""

import jax
import numpy as np
import pytest

from envs import export
from envs.flags import load_config
from rmp_mjx.training.policy import load_policy
from rmp_mjx.training.runs.policies import load_agent
from tests import toy_task
from tests.training import toys
from tests.training.conftest import run


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A finished run of two seeds."""
    folder = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        toy_task.register(patch)
        run(folder, num_seeds=2, seed=5)
        yield folder


@pytest.mark.parametrize("seed_index", [0, 1])
def test_an_exported_policy_acts_as_the_checkpoint(folder, tmp_path, seed_index):
    file = tmp_path / "toy.safetensors"
    options = [str(folder), str(file), "--seed_index", str(seed_index)]
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
    ],
)
def test_what_cannot_be_exported_is_said(
    folder, tmp_path, capsys, name, more, code, message
):
    (tmp_path / "there.safetensors").touch()
    assert export.main([str(folder), str(tmp_path / name), *more]) == code
    assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["there.safetensors"]
