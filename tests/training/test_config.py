"""Options: validation, the command line, files."""

import dataclasses
import re

import pytest

from envs import cli
from rmp_mjx.training.config import (
    ConfigError,
    TrainConfig,
    differing_fields,
    load_config,
    save_config,
    validate,
)

ENVS = ("trajectory", "door")


def test_the_defaults_are_valid():
    assert validate(TrainConfig(), ENVS) == TrainConfig()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"env": "trajectroy"}, "known: door, trajectory. Did you mean 'trajectory'"),
        ({"controller": "pid"}, "known: rmp_vices, vices"),
        ({"physics": "bullet"}, "known: auto, mujoco, mjx, warp"),
        ({"env_options": ("physics=mjx",)}, "an option of its own: --physics"),
        ({"num_envs": 0}, "num_envs must be at least 1"),
        ({"num_envs": 3, "unroll_length": 5}, "3 * 5 = 15 does not divide into"),
        ({"learning_rate": 0.0}, "learning_rate must be positive"),
        ({"learning_rate": float("nan")}, "learning_rate must be positive"),
        ({"discounting": 1.5}, r"discounting must lie in [0, 1]"),
        ({"hidden_sizes": ()}, "hidden_sizes"),
        ({"keep_every": 30}, "keep_every = 30 is no multiple of checkpoint_interval"),
        ({"resume": "a", "run_dir": "b"}, "leave run_dir out"),
        ({"resume": "a", "overwrite": True}, "exclude each other"),
    ],
)
def test_an_impossible_configuration_is_refused_by_name(changes, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        validate(TrainConfig(**changes), ENVS)


def test_underscores_and_hyphens_are_the_same():
    for option in ("--num_envs", "--num-envs"):
        assert cli.parse_train([option, "2048"]).num_envs == 2048


def test_every_option_is_documented_in_the_help(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.parse_train(["--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for field in dataclasses.fields(TrainConfig):
        assert field.name in text
    assert "Environments that run in parallel" in text


def test_a_wrong_option_exits_with_code_2():
    with pytest.raises(SystemExit) as stop:
        cli.parse_train(["--num_enws", "3"])
    assert stop.value.code == 2


def test_iterations_cover_the_timesteps():
    config = TrainConfig(num_envs=10, unroll_length=10, num_timesteps=301)
    assert (config.steps_per_iteration, config.num_iterations) == (100, 4)


def test_a_configuration_survives_its_file(tmp_path):
    config = TrainConfig(hidden_sizes=(3, 5), env_options=("layout=close",), seed=7)
    save_config(config, tmp_path / "config.json")
    assert load_config(tmp_path / "config.json") == config


def test_what_an_older_file_does_not_say_takes_its_default(tmp_path):
    (tmp_path / "config.json").write_text('{"hidden_sizes": [3, 5], "seed": 7}')
    assert load_config(tmp_path / "config.json") == TrainConfig(
        hidden_sizes=(3, 5), seed=7
    )


@pytest.mark.parametrize("content", ["{", "[]", '{"hidden_sizes": [], "x": 1}'])
def test_a_file_that_is_no_configuration_is_refused(tmp_path, content):
    (tmp_path / "config.json").write_text(content)
    with pytest.raises(ConfigError, match=r"config\.json"):
        load_config(tmp_path / "config.json")


def test_resuming_takes_the_saved_options_as_defaults(tmp_path):
    saved = TrainConfig(num_envs=64, run_dir=str(tmp_path))
    save_config(saved, tmp_path / "config.json")
    config = cli.parse_train(["--resume", str(tmp_path), "--num_timesteps", "9"])
    assert (config.num_envs, config.num_timesteps) == (64, 9)
    assert validate(config, ENVS).run_dir is None
    assert differing_fields(saved, config) == {}


def test_resuming_what_is_no_run_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="no run folder"):
        cli.parse_train(["--resume", str(tmp_path)])


def test_evaluation_needs_a_run_or_an_agent():
    with pytest.raises(ConfigError, match="either"):
        cli.EvalConfig().resolve()
    with pytest.raises(ConfigError, match="either"):
        cli.EvalConfig(run="x", agent="zero").resolve()
    (config,), out = cli.EvalConfig(agent="random", env="door").resolve()
    assert config.env == "door"
    assert str(out) == "runs/random-door-rmp_vices"


def test_an_agent_that_the_run_does_not_have_is_refused(tmp_path):
    save_config(TrainConfig(num_seeds=3), tmp_path / "config.json")
    cli.EvalConfig(run=str(tmp_path), seed_index=2).resolve()
    with pytest.raises(ConfigError, match=r"0 \.\. 2, the agents of the run; is 3"):
        cli.EvalConfig(run=str(tmp_path), seed_index=3).resolve()


def test_a_grid_is_resumed_with_the_options_it_was_started_with(tmp_path):
    folder = tmp_path / "grid"
    options = [
        "--envs",
        "trajectory,door",
        "--controllers",
        "vices",
        "--num_envs",
        "64",
    ]
    started = cli.parse_train([*options, "--run_dir", str(folder)]).grid
    started.save({})
    resumed = cli.parse_train(["--resume", str(folder)]).grid
    assert list(resumed.cells()) == ["trajectory-vices", "door-vices"]
    cell = resumed.cells()["door-vices"]
    assert (cell.num_envs, cell.env, cell.controller) == (64, "door", "vices")
    assert validate(cell, ENVS).run_dir == str(folder / "door-vices")


def test_evaluation_adds_its_options_to_the_runs_and_the_engine_to_both(tmp_path):
    save_config(TrainConfig(env_options=("layout=far",)), tmp_path / "config.json")
    asked = cli.EvalConfig(run=str(tmp_path), obstacles=2, physics="mujoco")
    (own, reference), out = asked.resolve()
    assert own.env_options == ("layout=far", "obstacles=2")
    assert own.physics == "auto" and reference.physics == "mujoco"
    extra = ("sim_dt=0.002", "cone=elliptic")
    assert reference.env_options == own.env_options + extra
    assert out == tmp_path
