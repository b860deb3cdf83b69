"""`train.py` from its command line to its results, on a toy task."""

import dataclasses
import json
import subprocess
import sys

import polars as pl
import pytest

from envs import grid, train
from rmp_mjx.training.config import TrainConfig
from rmp_mjx.training.policy import load_policy
from tests.envs import arm_tasks
from tests.training.conftest import SMALL

OPTIONS = [
    f"--{name}={value}"
    for name, value in SMALL.items()
    if name not in ("hidden_sizes", "video")
]
OPTIONS += [
    "--env",
    "counter",
    "--hidden_sizes",
    "4",
    "--no-video",
    "--num_timesteps",
    "256",
]


@pytest.fixture
def toy(monkeypatch):
    """Options that the toy was made with."""
    return arm_tasks.register(monkeypatch)


def test_a_run_trains_evaluates_and_plots(toy, tmp_path):
    folder = tmp_path / "run"
    options = [*OPTIONS, "--run_dir", str(folder)]
    assert train.main([*options, "--variant", "heavy"]) == 0
    assert toy[0].variant == "heavy"
    found = json.loads((folder / "eval.json").read_text())
    assert found["episodes"] == SMALL["eval_episodes"]
    wanted = "return_mean return_sd success_rate collision_episodes"
    assert set(wanted.split()) <= set(found)
    for name in ("versions.json", "metrics.parquet", "contact_forces.png"):
        assert (folder / name).exists()
    config = json.loads((folder / "config.json").read_text())
    assert config["task"]["variant"] == "heavy"
    assert (folder / "learning_curve.png").stat().st_size > 0
    assert "<h1>" in (folder / "report.html").read_text()
    assert not (folder / "video.mp4").exists()
    about = load_policy(folder / "policy.safetensors").about
    assert about["config"]["task"] == config["task"]
    assert (about["iterations"], about["steps"]) == (4, 256)
    assert about["evaluation"]["success_rate_ci95"] == found["success_rate_ci95"]
    assert about["evaluation"]["episodes"] == found["episodes"]

    assert train.main([*OPTIONS, "--run_dir", str(folder)]) == 2  # not empty
    assert train.main(["--resume", str(folder)]) == 0  # nothing left to do
    assert toy[-1].variant == "heavy"


def test_braxs_trainer_leaves_the_same_results_and_is_not_resumed(
    toy, tmp_path, capsys
):
    folder = tmp_path / "run"
    options = ["--trainer", "brax", "--run_dir", str(folder)]
    assert train.main([*OPTIONS, *options]) == 0
    found = json.loads((folder / "eval.json").read_text())
    assert found["episodes"] == SMALL["eval_episodes"]
    assert (folder / "learning_curve.png").stat().st_size > 0
    with pytest.raises(SystemExit, match="2"):
        train.main(["--resume", str(folder)])
    assert "brax cannot resume" in capsys.readouterr().err


def test_an_interrupted_cell_of_braxs_trainer_begins_anew(tmp_path):
    config = TrainConfig(arm_tasks.CounterOptions(), trainer="brax")
    cells = grid.Grid(tmp_path, {"counter": config}, ("vices",))
    cell = tmp_path / "counter-vices"
    cell.mkdir()
    (cell / "config.json").write_text("{}")
    run = cells.cells()["counter-vices"].run
    assert (run.resume, run.run_dir, run.overwrite) == (None, str(cell), True)


def test_several_seeds_leave_a_result_each_and_one_of_all(toy, tmp_path):
    folder = tmp_path / "run"
    options = [*OPTIONS, "--run_dir", str(folder), "--seed", "5", "--num_seeds", "2"]
    assert train.main(options) == 0
    found = json.loads((folder / "eval.json").read_text())
    own = [
        json.loads((folder / "seeds" / name / "eval.json").read_text())
        for name in ("5", "6")
    ]
    assert (found["seeds"], found["episodes"]) == (2, 2 * SMALL["eval_episodes"])
    returns = [one["return_mean"] for one in own]
    assert found["return_mean"] == pytest.approx(sum(returns) / 2)
    curves = pl.read_parquet(folder / "seeds" / "curves.parquet")
    assert curves["steps"].to_list() == [64, 128, 192, 256]
    assert "episode/return_low" in curves.columns
    assert (folder / "learning_curve.png").stat().st_size > 0

    for name, one in zip(("5", "6"), own, strict=True):
        policy = load_policy(folder / "seeds" / name / "policy.safetensors").about
        assert policy["config"]["ppo"]["seed"] == int(name)
        assert policy["evaluation"]["return_mean"] == one["return_mean"]

    assert train.main(["--resume", str(folder)]) == 0  # nothing left to do
    (folder / "eval.json").unlink()  # as if it was killed before the evaluation
    assert train.main(["--resume", str(folder)]) == 0
    assert json.loads((folder / "eval.json").read_text()) == found


def test_a_grid_trains_every_cell_and_goes_on_where_it_stopped(
    toy, tmp_path, monkeypatch, capsys
):
    folder = tmp_path / "grid"
    steps = ["--num_timesteps", "128", "--eval_episodes", "0"]
    options = [*OPTIONS, *steps, "--run_dir", str(folder)]
    options += ["--envs", "counter", "--controllers", "vices,rmp_vices"]
    trained = []

    whole = train.train

    def stopped(env, config, *rest):
        """The second cell is stopped by a signal after its first iteration."""
        trained.append(config.task.controller)
        if len(trained) == 1:
            return whole(env, config, *rest)
        half = config.replace(num_timesteps=64)
        return dataclasses.replace(whole(env, half, *rest), exit_code=143)

    with monkeypatch.context() as patch:
        patch.setattr(train, "train", stopped)
        assert train.main(options) == 143
    assert trained == ["vices", "rmp_vices"]
    said = "".join(capsys.readouterr().out.split())  # the terminal breaks lines
    assert f"--resume{folder}" in said
    assert train.main(options) == 2  # not empty
    assert train.main(["--resume", str(folder)]) == 0
    said = capsys.readouterr().out
    assert "cell 1/2: counter-vices has finished" in said
    cells = json.loads((folder / "grid.json").read_text())["finished"]
    assert list(cells) == ["counter-vices", "counter-rmp_vices"]
    for name in cells:
        config = json.loads((folder / name / "config.json").read_text())
        assert name == f"counter-{config['task']['controller']}"
        assert (folder / name / "learning_curve.png").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--env", "nowhere"], "valid names: "),
        (["--env", "trajectroy"], "Did you mean 'trajectory'"),
        (["--num-envs", "3", "--unroll_length", "5"], "does not divide"),
        (["--resume", "/nonexistent"], "no run folder"),
        (["--envs", "trajectory,nowhere"], "unknown env 'nowhere'"),
        (["--envs", "door,trajectory", "--variant", "heavy"], "--env trajectory"),
        (["--controllers", "vices,pid"], "unknown controller 'pid'"),
        (["--num_processes", "2"], "need --coordinator"),
        (["--num_seeds", "0"], "num_seeds must be at least 1"),
        (["--no_such_option"], "no_such_option"),
        (["--env_options", "obstacle=2"], "write --obstacle 2"),
        (["--obstacle", "2"], "--obstacles"),
        (["--layout", "near"], "'close'"),
        (["--env", "door", "--observation", "fixed"], "--observation"),
        (["--obstacles", "two"], "--obstacles"),
        (["--demos", "/nonexistent"], "no file of demonstrations /nonexistent"),
        (["--demos", "README.md"], "README.md is no file of demonstrations"),
        (["--trainer", "brax", "--num_seeds", "2"], "trains one seed"),
        (["--trainer", "brax", "--resume", "/nonexistent"], "no run folder"),
    ],
)
def test_wrong_options_exit_with_code_2_before_jax_starts(root, options, message):
    code = (
        "import sys, train\n"
        "try: code = train.main(sys.argv[1:])\n"
        "except SystemExit as stop: code = stop.code\n"
        "from jax._src import xla_bridge\n"
        "assert not xla_bridge.backends_are_initialized()\n"
        "sys.exit(code)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *options],
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    said = " ".join((done.stdout + done.stderr).replace("│", " ").split())
    assert message in said


def test_help_lists_the_options_of_the_task(capsys):
    with pytest.raises(SystemExit) as stop:
        train.main(["--env", "door", "--help"])
    assert stop.value.code == 0
    said = capsys.readouterr().out
    assert "--num_envs" in said and "--variant {light,heavy,vices}" in said
    assert "--block_mass" not in said and "--observation" not in said
