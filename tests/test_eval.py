"""`eval.py`: a run's policy and trivial agents, on a toy task."""

import importlib
import json
import types

import pytest

from tests.training import toys
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
def evaluate(monkeypatch):
    module = importlib.import_module("eval")
    fake = types.SimpleNamespace(
        names=lambda: ("counter", "trajectory"),
        load=lambda name, **options: toys.Counter(),
    )
    monkeypatch.setattr(module, "envs", fake)
    return module.main


def test_a_run_is_evaluated_into_its_folder(evaluate, tmp_path, capsys):
    folder = tmp_path / "run"
    run(folder)
    options = ["--run", str(folder), "--episodes", "9", "--deterministic"]
    assert evaluate(options) == 0
    found = json.loads((folder / "eval.json").read_text())
    assert set(WANTED) <= set(found)
    assert (found["episodes"], found["deterministic"]) == (9, True)
    assert found["training_iterations"] == 4
    assert "return_mean" in capsys.readouterr().out
    assert evaluate(options) == 0
    assert json.loads((folder / "eval.json").read_text()) == found


@pytest.mark.parametrize("agent", ["zero", "random"])
def test_an_agent_needs_no_run(evaluate, tmp_path, agent):
    options = ["--agent", agent, "--env", "counter", "--out", str(tmp_path)]
    assert evaluate([*options, "--episodes", "4"]) == 0
    found = json.loads((tmp_path / "eval.json").read_text())
    assert set(WANTED) <= set(found)
    assert found["agent"] == agent


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["--run", "/nonexistent"],
        ["--agent", "zero", "--env", "nowhere"],
        ["--agent", "zero", "--episodes", "0"],
    ],
)
def test_wrong_options_exit_with_code_2(evaluate, options, capsys):
    assert evaluate(options) == 2
    assert capsys.readouterr().err.startswith("error: ")


def test_a_run_without_checkpoints_exits_with_code_1(evaluate, tmp_path, capsys):
    folder = tmp_path / "run"
    run(folder)
    for path in sorted((folder / "checkpoints").rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    assert evaluate(["--run", str(folder)]) == 1
    assert "no usable checkpoint" in capsys.readouterr().err
