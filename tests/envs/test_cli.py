"""The command lines of train.py and eval.py."""

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
)
from rmp_mjx.training.records import differing_fields, read_record, save_config

OLD = Path(__file__).with_name("config-0.1.json")
"""A configuration as version 0.1 wrote it."""


def parsed(*args):
    """The configuration that flags ask for."""
    return cli.parse_train([str(arg) for arg in args])[0].config


def grid(*args):
    """The grid that flags ask for."""
    _, found = cli.parse_train([str(arg) for arg in args])
    assert found
    return found


def test_a_configuration_is_made_from_flat_names():
    config = make_config("door", obstacles=2, num_envs=64, video=False)
    assert (config.task.obstacles, config.ppo.num_envs) == (2, 64)
    assert not config.run.video and config.trainer == "ours"
    assert config.replace(obstacles=0, num_envs=256, video=True) == make_config("door")
    task = make_config("push").task
    assert config.replace(task=task, physics="mjx").task == dataclasses.replace(
        task, physics="mjx"
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"env": "trajectroy"}, "trajectory, door, push. Did you mean 'trajectory'"),
        ({"controller": "pid"}, "valid names: rmp_vices, vices"),
        ({"physics": "bullet"}, "valid names: auto, mujoco, mjx, warp"),
        ({"num_env": 3}, "Did you mean 'num_envs'"),
        ({"env": "door", "variants": "light"}, "Did you mean 'variant'"),
        ({"env": "push", "variant": "light"}, "unknown option 'variant'"),
    ],
)
def test_an_unknown_name_or_value_is_refused_with_the_valid_ones(changes, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        make_config(**changes)


def test_resuming_takes_the_saved_options_as_defaults(tmp_path):
    saved = make_config("door", num_envs=64, obstacles=1, run_dir=str(tmp_path))
    save_config(saved, tmp_path / "config.json")
    config = parsed("--resume", tmp_path, "--num_timesteps", "9")
    assert config == saved.replace(num_timesteps=9, run_dir=None, resume=str(tmp_path))
    assert differing_fields(saved.record(), config) == {}


def test_resuming_with_other_options_names_them(tmp_path):
    saved = make_config("door", num_envs=64)
    save_config(saved, tmp_path / "config.json")
    config = parsed("--resume", tmp_path, "--num_envs", "8", "--obstacles", "2")
    assert differing_fields(saved.record(), config) == {
        "num_envs": (64, 8),
        "obstacles": (0, 2),
    }
    other = parsed("--resume", tmp_path, "--env", "push")
    assert differing_fields(saved.record(), other)["env"] == ("door", "push")


def test_resuming_what_is_no_run_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="no run folder"):
        parsed("--resume", tmp_path)


def test_a_run_of_version_0_1_is_not_resumed(tmp_path):
    (tmp_path / "config.json").write_text(OLD.read_text())
    config = parsed("--resume", tmp_path)
    assert config == load_config(tmp_path).replace(resume=str(tmp_path))
    with pytest.raises(ConfigError, match=r"of version 0\.1"):
        differing_fields(read_record(tmp_path / "config.json"), config)


def test_evaluation_needs_a_run_or_an_agent(tmp_path):
    save_config(make_config(), tmp_path / "config.json")
    for wrong in ([], ["--run", str(tmp_path), "--agent", "zero"]):
        with pytest.raises(ConfigError, match="either"):
            cli.parse_eval(wrong)
    options, config = cli.parse_eval(["--agent", "random", "--env", "door"])
    assert options.tasks == [envs.make_options("door")]
    assert config is None
    assert str(options.folder) == "runs/random-door-rmp_vices"


def test_an_agent_that_the_run_does_not_have_is_refused(tmp_path):
    save_config(make_config(num_seeds=3), tmp_path / "config.json")
    run = ["--run", str(tmp_path), "--seed_index"]
    assert cli.parse_eval([*run, "2"])[0].seed_index == 2
    with pytest.raises(ConfigError, match=r"0 \.\. 2, the agents of the run; is 3"):
        cli.parse_eval([*run, "3"])


def test_evaluation_adds_its_options_to_the_runs_and_the_engine_to_both(tmp_path):
    saved = make_config("door", layout="close", variant="heavy")
    save_config(saved, tmp_path / "config.json")
    options, config = cli.parse_eval(
        ["--run", str(tmp_path), "--obstacles", "2", "--physics", "mujoco"]
    )
    own, reference = options.tasks
    assert config == saved
    assert own == dataclasses.replace(saved.task, obstacles=2)
    assert reference == dataclasses.replace(
        own, physics="mujoco", sim_dt=0.002, cone="elliptic"
    )
    assert options.folder == tmp_path


def test_a_grid_is_resumed_with_the_options_it_was_started_with(tmp_path):
    folder = tmp_path / "grid"
    options = "--envs trajectory,door --controllers vices --num_envs 64 --obstacles 1"
    grid(*options.split(), "--run_dir", folder).save({})
    cells = grid("--resume", folder).cells()
    assert list(cells) == ["trajectory-vices", "door-vices"]
    for env in ("trajectory", "door"):
        name = f"{env}-vices"
        assert cells[name] == make_config(
            env,
            controller="vices",
            num_envs=64,
            obstacles=1,
            run_dir=str(folder / name),
            overwrite=True,
        )


def test_a_grid_of_version_0_1_is_read(tmp_path):
    old = json.loads(OLD.read_text()) | {"env_options": ["obstacles=1"]}
    saved = {"config": old, "envs": ["door", "push"], "controllers": ["osc"]}
    (tmp_path / "grid.json").write_text(json.dumps(saved))
    cells = grid("--resume", tmp_path).cells()
    assert list(cells) == ["door-osc", "push-osc"]
    assert cells["push-osc"].task.obstacles == 1


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
