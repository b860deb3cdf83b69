"""`train.py` from its command line to its results, on a toy task."""

import json
import subprocess
import sys
import types

import pytest

import train
from tests.training import toys
from tests.training.conftest import SMALL

OPTIONS = [
    f"--{name}={value}"
    for name, value in SMALL.items()
    if name not in ("hidden_sizes", "video")
]
OPTIONS += ["--hidden_sizes", "4", "--no-video", "--num_timesteps", "256"]


@pytest.fixture
def toy(monkeypatch):
    """Options that the toy was loaded with."""
    asked = []

    def load(name, **options):
        asked.append(options)
        return toys.Counter()

    fake = types.SimpleNamespace(
        names=lambda: ("counter",),
        load=load,
        parse_options=lambda name, texts: dict(text.split("=") for text in texts),
    )
    monkeypatch.setattr(train, "envs", fake)
    monkeypatch.setattr(train, "engine", lambda env: "toy")
    return asked


def test_a_run_trains_evaluates_and_plots(toy, tmp_path):
    folder = tmp_path / "run"
    options = [*OPTIONS, "--run_dir", str(folder)]
    assert train.main([*options, "--env_options", "variant=heavy"]) == 0
    assert toy[0]["variant"] == "heavy"
    found = json.loads((folder / "eval.json").read_text())
    assert found["episodes"] == SMALL["eval_episodes"]
    wanted = "return_mean return_sd success_rate collision_episodes"
    assert set(wanted.split()) <= set(found)
    for name in ("versions.json", "metrics.parquet", "contact_forces.png"):
        assert (folder / name).exists()
    config = json.loads((folder / "config.json").read_text())
    assert config["env_options"] == ["variant=heavy"]
    assert (folder / "learning_curve.png").stat().st_size > 0
    assert not (folder / "video.mp4").exists()

    assert train.main([*OPTIONS, "--run_dir", str(folder)]) == 2  # not empty
    assert train.main(["--resume", str(folder)]) == 0  # nothing left to do
    assert toy[-1]["variant"] == "heavy"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--env", "nowhere"], "known: "),
        (["--num-envs", "3", "--unroll_length", "5"], "does not divide"),
        (["--resume", "/nonexistent"], "no run folder"),
        (["--no_such_option"], "no_such_option"),
        (["--env_options", "obstacle=2"], "Did you mean 'obstacles'"),
        (["--env_options", "layout=near"], "far, close"),
        (["--env_options", "obstacles=two"], "obstacles must be a int"),
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
    assert message in done.stdout + done.stderr


def test_help_exits_with_code_0(capsys):
    with pytest.raises(SystemExit) as stop:
        train.main(["--help"])
    assert stop.value.code == 0
    assert "--num_envs" in capsys.readouterr().out
