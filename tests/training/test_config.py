"""Parts of a training configuration: checked, compared, written."""

import dataclasses
import json
import re

import pytest

from rmp_mjx.training.config import (
    ConfigError,
    TrainConfig,
)
from rmp_mjx.training.records import (
    config_of,
    differing_fields,
    read_record,
    save_config,
)


@dataclasses.dataclass(frozen=True)
class Task:
    """All that training asks of a task's options: a title and a record."""

    size: int = 3
    title = "a task"

    def record(self):
        return {"size": self.size}


CONFIG = TrainConfig(Task())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_env": 3}, "Did you mean 'num_envs'"),
        ({"sizes": 4}, "Did you mean 'size'"),
        ({"num_envs": 0}, "num_envs must be at least 1"),
        ({"num_devices": 0}, "num_devices must be at least 1"),
        ({"num_envs": 3, "unroll_length": 5}, "3 * 5 = 15 does not divide into"),
        ({"learning_rate": 0.0}, "learning_rate must be positive"),
        ({"learning_rate": float("nan")}, "learning_rate must be finite"),
        ({"entropy_cost": float("inf")}, "entropy_cost must be finite"),
        ({"init_log_std": 1000.0}, "init_log_std must lie within"),
        ({"num_envs": "8"}, "num_envs must be a whole number, is '8'"),
        ({"num_envs": 8.0}, "num_envs must be a whole number, is 8.0"),
        ({"num_envs": True}, "num_envs must be a whole number, is True"),
        ({"num_envs": 10**20}, "num_envs has more than 64 bits"),
        ({"num_envs": 2**31}, "num_envs must be at most"),
        (
            {"num_updates_per_batch": 1001},
            "num_updates_per_batch must be at most 1,000",
        ),
        ({"hidden_sizes": (4, "x")}, "hidden_sizes must be a whole number"),
        ({"hidden_sizes": "64"}, "hidden_sizes must be several values"),
        ({"seed": -1}, "seed must not be negative"),
        ({"seed": 2**32}, "seed must have 32 bits"),
        ({"seed": 2**32 - 2, "num_seeds": 3}, "seed must have 32 bits"),
        ({"video": 1}, "video must be true or false"),
        ({"run_dir": ""}, "run_dir is empty"),
        ({"resume": " "}, "resume is empty"),
        ({"trainer": "theirs"}, "valid names: ours, brax"),
        ({"discounting": 1.5}, r"discounting must lie in [0, 1]"),
        ({"hidden_sizes": ()}, "hidden_sizes"),
        ({"keep_every": 30}, "keep_every = 30 is no multiple of checkpoint_interval"),
        ({"resume": "a", "run_dir": "b"}, "leave run_dir out"),
        ({"resume": "a", "overwrite": True}, "exclude each other"),
        ({"trainer": "brax", "resume": "a"}, "brax cannot resume"),
        ({"trainer": "brax", "num_seeds": 2}, "trains one seed"),
        ({"trainer": "brax", "demos": "x"}, "brax clones no demos"),
        ({"trainer": "brax", "final_log_std": -2.0}, "brax has no final_log_std"),
        ({"anneal_steps": 0}, "anneal_steps must be at least 1"),
    ],
)
def test_an_impossible_configuration_is_refused_by_name(changes, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        CONFIG.replace(**changes)


def test_iterations_cover_the_timesteps():
    config = CONFIG.replace(num_envs=10, unroll_length=8, num_timesteps=301)
    assert (config.ppo.steps_per_iteration, config.num_iterations) == (80, 4)


def test_a_copy_finds_the_part_of_each_name():
    config = CONFIG.replace(size=4, seed=5, video=False, trainer="brax")
    assert config == TrainConfig(
        Task(4),
        dataclasses.replace(CONFIG.ppo, seed=5),
        dataclasses.replace(CONFIG.run, video=False),
        "brax",
    )
    assert config.replace(task=Task(5), seed=0).task == Task(5)


def test_the_title_says_the_task_and_the_seeds():
    assert CONFIG.replace(seed=5).title == "a task, seed 5"
    assert CONFIG.replace(seed=5, num_seeds=2).title == "a task, seeds 5 to 6"


def test_what_defines_a_run_is_compared():
    config = CONFIG.replace(size=4, num_seeds=2, hidden_sizes=(3,), num_timesteps=9)
    assert differing_fields(CONFIG.record(), config) == {
        "size": (3, 4),
        "num_seeds": (1, 2),
        "hidden_sizes": ([64, 64], [3]),
    }
    assert differing_fields(config.record(), config) == {}


def test_a_configuration_survives_its_file(tmp_path):
    config = CONFIG.replace(size=4, hidden_sizes=(3, 5), seed=7)
    save_config(config, tmp_path / "config.json", environment={"arm": "mine"})
    record = read_record(tmp_path / "config.json")
    assert record.pop("environment") == {"arm": "mine"}
    assert record == json.loads(json.dumps(config.record()))
    assert config_of(record, lambda task: Task(**task)) == config
