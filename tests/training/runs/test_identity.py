"""A run knows the environment that it was trained in."""

import dataclasses
import json

import pytest

from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.runs import identity, run_folder
from rmp_mjx.training.runs.loop import train
from rmp_mjx.training.runs.policies import load_agent
from tests.training import toys
from tests.training.conftest import small

STEPS = {"num_timesteps": 64, "eval_episodes": 0}


@dataclasses.dataclass(frozen=True)
class Armed(toys.Counter):
    """The counting toy with an arm."""

    arm: str = "panda"

    @property
    def identity(self):
        return {"arm": f"'{self.arm}'"}


def trained(folder, env, **changes):
    config = small(**STEPS, **changes)
    _, lock = run_folder.open_run(config)
    with lock:
        return train(env, config, folder), config


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run with one arm, and its configuration."""
    folder = tmp_path_factory.mktemp("armed") / "run"
    _, config = trained(folder, Armed(), run_dir=str(folder))
    return folder, config


def test_a_run_records_its_arm(run):
    record = json.loads((run[0] / run_folder.CONFIG).read_text())
    assert record["environment"] == {"arm": "'panda'"}
    assert identity.saved(run[0] / run_folder.CONFIG) == {"arm": "'panda'"}


@pytest.mark.parametrize(
    ("env", "other"), [(Armed(arm="jaco2"), "'jaco2'"), (toys.Counter(), "the usual")]
)
def test_another_arm_is_refused(run, env, other):
    folder, config = run
    message = f"was trained with the arm 'panda', not with {other}"
    with pytest.raises(ConfigError, match=message):
        load_agent(env, config, folder, True, pytest.fail)
    with pytest.raises(ConfigError, match=message):
        trained(folder, env, resume=str(folder))
    assert identity.saved(folder / run_folder.CONFIG) == {"arm": "'panda'"}


def test_the_same_arm_is_taken(run):
    folder, config = run
    assert load_agent(Armed(), config, folder, True, pytest.fail)[0] == 1
    result, _ = trained(folder, Armed(), resume=str(folder))
    assert result.had_finished


def test_a_run_that_recorded_no_arm_goes_with_any(run, tmp_path):
    identity.check({}, Armed(), tmp_path)
    assert identity.saved(tmp_path / run_folder.CONFIG) == {}


def test_a_policy_may_go_to_another_arm_if_that_is_wanted(run):
    folder, config = run
    other = Armed(arm="jaco2")
    besides = (identity.ARM,)
    found = load_agent(other, config, folder, True, pytest.fail, besides=besides)
    assert found[0] == load_agent(Armed(), config, folder, True, pytest.fail)[0]
