"""`eval.py`: a run's policy and trivial agents, on a toy task."""

import dataclasses
import json
import shutil

import polars as pl
import pytest

import envs
from envs import eval as evaluation
from rmp_mjx.training.runs import policies
from tests.envs import arm_tasks
from tests.training.conftest import run

WANTED = (
    "episodes",
    "return_mean",
    "return_sd",
    "success_rate",
    "success_rate_ci95",
    "collision_episodes",
    "collision_rate_ci95",
)


@pytest.fixture
def asked(monkeypatch):
    """Options that tasks were made with."""
    return arm_tasks.register(monkeypatch)


@pytest.fixture
def evaluate(asked):
    return evaluation.main


def test_a_run_is_evaluated_into_its_folder(evaluate, tmp_path, capsys):
    folder = tmp_path / "run"
    run(folder)
    options = ["--run", str(folder), "--episodes", "9", "--deterministic", "--no-video"]
    assert evaluate(options) == 0
    found = json.loads((folder / "eval.json").read_text())
    assert set(WANTED) <= set(found)
    assert (found["episodes"], found["deterministic"]) == (9, True)
    assert (found["training_iterations"], found["engine"]) == (4, "auto")
    assert "reference" not in found
    said = capsys.readouterr().out
    assert "policy agent, counter, rmp_vices, no obstacles, 9 episodes" in said
    assert "return, mean +- sd" in said
    for name in ("contact_forces.png", "clearances.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
    assert len(pl.read_parquet(folder / "episodes.parquet")) == 9
    assert evaluate(options) == 0
    assert json.loads((folder / "eval.json").read_text()) == found


def test_a_policy_goes_to_another_arm_that_is_named(evaluate, asked, tmp_path, capsys):
    folder = tmp_path / "run"
    run(folder)
    options = ["--run", str(folder), "--episodes", "9", "--no-video"]
    assert evaluate([*options, "--robot", "ur5e"]) == 0
    assert asked[-1].robot == "ur5e"
    said = capsys.readouterr().out
    assert "trained with the arm 'jaco2', evaluated with 'ur5e'" in said
    assert "counter, rmp_vices, ur5e" in said
    with pytest.raises(SystemExit, match="2"):
        evaluate([*options, "--robot", "urfive"])


def test_a_policy_file_is_evaluated_as_its_run_into_a_folder_of_its_name(
    evaluate, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "run"
    result, config = run(folder)
    kept = tmp_path / "kept"
    kept.mkdir()
    (file,) = policies.save(result.agent, config, folder, result.iterations, False)
    shutil.copy(file, kept / "toy.safetensors")
    options = ["--episodes", "9", "--seed", "4", "--no-video", "--run"]
    assert evaluate([*options, "run"]) == 0
    wanted = json.loads((folder / "eval.json").read_text())
    for name in ("kept/toy", "kept/toy.safetensors"):
        assert evaluate([*options, name]) == 0
        found = json.loads((tmp_path / "runs" / "toy" / "eval.json").read_text())
        assert found["run"] == "kept/toy.safetensors"
        assert {**found, "run": "run"} == wanted
        shutil.rmtree(tmp_path / "runs")
    assert [path.name for path in kept.iterdir()] == ["toy.safetensors"]
    (folder / "eval.json").unlink()
    assert evaluate([*options, str(file)]) == 0  # a run's own file: into its folder
    assert (folder / "eval.json").exists()
    capsys.readouterr()
    for more in (["--checkpoint", "best"], ["--seed_index", "1"]):
        assert evaluate([*options, "kept/toy", *more]) == 2
        assert more[0][2:] in capsys.readouterr().err
    (kept / "toy.safetensors").write_bytes(b"no policy")
    assert evaluate([*options, "kept/toy"]) == 2
    assert "toy.safetensors is damaged" in capsys.readouterr().err


def test_a_policy_for_another_task_is_refused(evaluate, tmp_path, capsys):
    result, config = run(tmp_path / "run")
    (file,) = policies.save(
        result.agent, config, tmp_path / "run", result.iterations, False
    )
    assert evaluate(["--run", str(file), "--env", "trajectory"]) == 2
    assert "does not fit the environment" in capsys.readouterr().err


def test_options_of_the_task_override_the_runs(evaluate, asked, tmp_path):
    folder = tmp_path / "run"
    task = arm_tasks.CounterOptions(variant="heavy", layout="far", obstacle_noise=0.01)
    run(folder, task=task)
    options = ["--run", str(folder), "--out", str(tmp_path / "out"), "--no-video"]
    options += ["--episodes", "4", "--obstacles", "2", "--layout", "close"]
    options += ["--obstacle_speed", "0.1", "--no_terminate_on_event"]
    assert evaluate(options) == 0
    wanted = dataclasses.replace(
        task,
        obstacles=2,
        layout="close",
        obstacle_speed=0.1,
        terminate_on_event=False,
    )
    found = json.loads((tmp_path / "out" / "eval.json").read_text())
    assert found["task"] == wanted.record()
    assert asked == [wanted]


def test_a_run_of_another_arm_is_refused_and_its_evaluation_kept(
    evaluate, tmp_path, capsys
):
    folder = tmp_path / "run"
    run(folder)
    path = folder / "config.json"
    record = json.loads(path.read_text()) | {"environment": {"arm": "'panda' (ab12)"}}
    path.write_text(json.dumps(record))
    (folder / "eval.json").write_text("kept")
    assert evaluate(["--run", str(folder)]) == 2
    said = capsys.readouterr().err
    assert "was trained with the arm 'panda' (ab12), not with" in said
    assert (folder / "eval.json").read_text() == "kept"


def test_a_second_engine_gives_a_second_column(evaluate, asked, tmp_path, capsys):
    options = ["--agent", "zero", "--env", "counter", "--out", str(tmp_path)]
    options += ["--episodes", "5", "--physics", "mujoco", "--no-video"]
    assert evaluate(options) == 0
    assert [task.physics for task in asked] == ["auto", "mujoco"]
    assert asked[1] == dataclasses.replace(
        asked[0], physics="mujoco", sim_dt=0.002, cone="elliptic"
    )
    assert asked[0].sim_dt == 0.005
    found = json.loads((tmp_path / "eval.json").read_text())
    assert (found["engine"], found["reference"]["engine"]) == ("auto", "mujoco")
    # The toy knows no engines: the same starts must give the same values.
    assert found["reference"]["return_mean"] == found["return_mean"]
    header = next(
        x for x in capsys.readouterr().out.splitlines() if "episodes (95" in x
    )
    assert "auto" in header and "mujoco" in header
    rows = pl.read_parquet(tmp_path / "episodes.parquet")
    assert rows["engine"].to_list() == ["auto"] * 5 + ["mujoco"] * 5


def test_a_task_that_cannot_be_drawn_says_so_in_one_line(evaluate, tmp_path, capsys):
    options = ["--agent", "zero", "--env", "counter", "--out", str(tmp_path)]
    assert evaluate([*options, "--episodes", "2"]) == 0
    assert capsys.readouterr().out.count("no pictures: ") == 1


def test_the_title_says_what_is_simulated_and_where():
    env = envs.load("trajectory", physics="mujoco")
    assert env.engine == "mujoco, 5 ms, pyramidal"
    assert env.options.spheres == "no obstacles"
    env = envs.load(
        "trajectory", physics="mjx", obstacles=2, layout="close", obstacle_delay=0.1
    )
    assert env.engine == "mjx, 5 ms, pyramidal"
    assert env.options.spheres == "2 spheres (close, delay 0.1)"


@pytest.mark.parametrize("agent", ["zero", "random"])
def test_an_agent_needs_no_run(evaluate, tmp_path, agent):
    options = ["--agent", agent, "--env", "counter", "--out", str(tmp_path)]
    assert evaluate([*options, "--episodes", "4", "--no-video"]) == 0
    found = json.loads((tmp_path / "eval.json").read_text())
    assert set(WANTED) <= set(found)
    assert found["agent"] == agent


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["--run", "/nonexistent"],
        ["--agent", "zero", "--env", "nowhere"],
        ["--agent", "zero", "--env_options", "obstacles=2"],
    ],
)
def test_wrong_options_exit_with_code_2(evaluate, options, capsys):
    assert evaluate(options) == 2
    assert capsys.readouterr().err.startswith("error: ")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--episodes", "0"], "episodes must be at least 1"),
        (["--obstacle", "2"], "--obstacles"),
        (["--layout", "near"], "('far', 'close')"),
        (["--physics", "auto"], "'mjx'"),
    ],
)
def test_wrong_flags_exit_with_code_2_and_the_valid_ones(
    evaluate, options, message, capsys
):
    with pytest.raises(SystemExit) as stop:
        evaluate(["--agent", "zero", *options])
    assert stop.value.code == 2
    said = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert message in said


def test_help_lists_the_options_of_the_task(evaluate, capsys):
    with pytest.raises(SystemExit) as stop:
        evaluate(["--env", "push", "--agent", "zero", "--help"])
    assert stop.value.code == 0
    said = capsys.readouterr().out
    assert "--block_mass" in said and "--variant" not in said
    assert said.count("--physics") == 1  # the second engine's


def test_a_run_without_checkpoints_exits_with_code_1(evaluate, tmp_path, capsys):
    folder = tmp_path / "run"
    run(folder)
    for path in sorted((folder / "checkpoints").rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    assert evaluate(["--run", str(folder)]) == 1
    assert "no usable checkpoint" in capsys.readouterr().err
