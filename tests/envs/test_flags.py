"""Flags of the command line, and configurations in files."""

import dataclasses
import json
import re
from pathlib import Path

import pytest

import envs
from envs import cli
from envs.cli import make_config
from envs.flags import Processes, load_config
from rmp_mjx.training.config import (
    ConfigError,
    PPOConfig,
    RunConfig,
    differing_fields,
    save_config,
)

OLD = Path(__file__).with_name("config-0.1.json")
"""A configuration as version 0.1 wrote it."""


def parsed(*args):
    """The configuration that flags ask for."""
    return cli.parse_train([str(arg) for arg in args])[0].config


@pytest.mark.parametrize("env", envs.names())
def test_no_flag_is_the_default_configuration(env):
    assert parsed("--env", env) == make_config(env)


@pytest.mark.parametrize("env", envs.names())
def test_no_two_parts_have_an_option_of_the_same_name(env):
    parts = (envs.task(env).Options, PPOConfig, RunConfig, Processes)
    names = [field.name for part in parts for field in dataclasses.fields(part)]
    names += ["env", "envs", "controllers", "trainer"]
    assert len(set(names)) == len(names)


def test_underscores_and_hyphens_are_the_same():
    for option in ("--num_envs", "--num-envs"):
        assert parsed(option, 2048) == make_config(num_envs=2048)


def test_options_of_the_task_are_flags():
    flags = "--variant heavy --obstacles 2 --layout=close --no_terminate_on_event"
    assert parsed("--env=door", *flags.split()) == make_config(
        "door", variant="heavy", obstacles=2, layout="close", terminate_on_event=False
    )


@pytest.mark.parametrize("env", envs.names())
def test_every_option_is_documented_in_the_help(capsys, monkeypatch, env):
    monkeypatch.setenv("COLUMNS", "400")
    with pytest.raises(SystemExit) as stop:
        parsed("--env", env, "--help")
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for part in (envs.task(env).Options, PPOConfig, RunConfig, Processes):
        for field in dataclasses.fields(part):
            told = re.split(rf"--{field.name}[ ,]", text)[1].split("│ --")[0]
            assert "(default: " in told and len(told.split()) > 5, field.name


def test_a_wrong_option_exits_with_code_2():
    with pytest.raises(SystemExit) as stop:
        parsed("--num_enws", "3")
    assert stop.value.code == 2


def test_a_configuration_survives_its_file(tmp_path):
    config = make_config("push", hidden_sizes=(3, 5), layout="close", seed=7)
    save_config(config, tmp_path / "config.json")
    assert load_config(tmp_path) == config


def test_what_an_older_file_does_not_say_takes_its_default(tmp_path):
    record = {"task": {"env": "door"}, "ppo": {"hidden_sizes": [3, 5]}, "run": {}}
    (tmp_path / "config.json").write_text(json.dumps(record))
    config = make_config("door", hidden_sizes=(3, 5))
    assert load_config(tmp_path) == config
    assert differing_fields(record, config) == {}


def test_a_configuration_of_version_0_1_is_read(tmp_path):
    (tmp_path / "config.json").write_text(OLD.read_text())
    assert load_config(tmp_path) == make_config(
        "door",
        controller="vices",
        variant="heavy",
        obstacles=2,
        terminate_on_event=False,
        num_timesteps=1_500_000,
        seed=1,
        eval_episodes=0,
        video=False,
    )


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        "{}",
        '{"hidden_sizes": [], "x": 1}',
        '{"env": "door", "env_options": [], "x": 1}',
        '{"task": {"env": "door"}, "ppo": {"x": 1}, "run": {}}',
        '{"task": {"env": "door", "x": 1}, "ppo": {}, "run": {}}',
        '{"task": {}, "ppo": {}, "run": {}}',
    ],
)
def test_a_file_that_is_no_configuration_is_refused(tmp_path, content):
    (tmp_path / "config.json").write_text(content)
    with pytest.raises(ConfigError, match=r"config\.json"):
        load_config(tmp_path)
