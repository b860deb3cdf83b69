"""TensorBoard's files, and the trackers that need an extra."""

import importlib
import io
import struct
import sys

import pytest
from rich.console import Console

from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.runs import run_folder, trackers
from rmp_mjx.training.runs.logging import RunLogger
from rmp_mjx.training.runs.trackers import TensorBoard
from tests.training.conftest import small

ROW = {"iteration": 1, "steps": 10, "episode/return": 2.5, "episode/success": None}

WANDB = """
from pathlib import Path

class Run:
    def __init__(self, file):
        self.file = file
    def log(self, values, step):
        self.file.open("a").write(f"{step} {values}\\n")
    def finish(self, exit_code):
        self.file.open("a").write(f"exit {exit_code}\\n")

def init(project, name, id, resume, dir, config):
    file = Path(dir) / f"{project}-{id}"
    file.open("a").write(f"{resume} {config['env']}\\n")
    return Run(file)
"""

MLFLOW = """
from pathlib import Path
from types import SimpleNamespace

said = []

def set_experiment(name):
    return SimpleNamespace(experiment_id=f"id of {name}")

class MlflowClient:
    def __getattr__(self, method):
        def call(*args, **kwargs):
            said.append((method, *args, *kwargs.values()))
            return SimpleNamespace(info=SimpleNamespace(run_id="run7"))
        return call
"""


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """`fake(name, source)` installs a module of that name for this test."""
    packages = tmp_path / "packages"
    packages.mkdir()
    monkeypatch.syspath_prepend(packages)
    installed = []

    def install(name, source):
        (packages / f"{name}.py").write_text(source)
        sys.modules.pop(name, None)
        installed.append(name)

    yield install
    for name in installed:
        sys.modules.pop(name, None)


def log(folder, config, after=None, rows=(ROW,)):
    opened = trackers.open_trackers(config, folder, folder / "tb", after)
    text = io.StringIO()
    console = Console(file=text, width=200)
    with RunLogger(folder / "m.parquet", {}, 1, 0, console, opened) as logger:
        for row in rows:
            logger.add(row)
    return text.getvalue()


def events(folder):
    """Events of all files in a folder, in order."""
    found = []
    for path in sorted(folder.iterdir(), key=lambda p: p.stat().st_mtime_ns):
        data = path.read_bytes()
        while data:
            (size,) = struct.unpack("Q", data[:8])
            found.append(trackers.Event.FromString(data[12 : 12 + size]))
            data = data[16 + size :]
    return found


def records(file):
    """Records of an offline run: LevelDB's log format, short of one 32 KiB block."""
    data = file.read_bytes()
    assert len(data) < 32768
    data = data[7:]  # the file's own header
    while data:
        _, size, kind = struct.unpack("<IHB", data[:7])
        assert kind == 1  # whole
        yield data[7 : 7 + size]
        data = data[7 + size :]


def test_tensorboard_shows_each_value_at_its_policy_step(tmp_path):
    log(tmp_path, small())
    (found,) = (e for e in events(tmp_path / "tb") if e.HasField("summary"))
    (value,) = found.summary.value
    assert (found.step, value.tag, value.simple_value) == (10, "episode/return", 2.5)


def test_a_resumed_run_keeps_tensorboards_values_up_to_where_it_goes_on(tmp_path):
    """TensorBoard drops what comes at or after the step of a START event."""
    for after in (None, 640):
        tensorboard = TensorBoard(tmp_path, after)
        tensorboard.add(640, {"x": 1.0})
        tensorboard.close(0)
    starts = [e.step for e in events(tmp_path) if e.HasField("session_log")]
    assert starts == [641]
    assert trackers.SessionLog.START == 1


@pytest.mark.parametrize("name", trackers.OPTIONAL)
def test_a_tracker_that_is_not_installed_is_refused_before_anything_starts(
    name, tmp_path, monkeypatch
):
    monkeypatch.setattr(trackers.importlib.util, "find_spec", lambda name: None)
    config = small(run_dir=str(tmp_path / "run"), **{name: "project"})
    with pytest.raises(ConfigError, match=rf"pip install 'rmp-mjx\[{name}\]'"):
        run_folder.open_run(config)
    assert not (tmp_path / "run").exists()


def test_weights_and_biases_gets_the_rows_and_a_resumed_run_its_old_entry(
    tmp_path, fake
):
    fake("wandb", WANDB)
    config = small(wandb="arm")
    log(tmp_path, config)
    log(tmp_path, config, after=10)
    (file,) = tmp_path.glob("arm-*")
    lines = file.read_text().splitlines()
    assert lines == ["allow counter", "10 {'episode/return': 2.5}", "exit 0"] * 2


def test_mlflow_gets_the_rows_and_a_resumed_run_its_old_entry(tmp_path, fake):
    fake("mlflow", MLFLOW)
    config = small(mlflow="arm")
    log(tmp_path, config)
    log(tmp_path, config, after=10)
    said = sys.modules["mlflow"].said
    assert [call for call in said if call[0] == "create_run"] == [
        ("create_run", "id of arm", tmp_path.name)
    ]
    assert ("log_param", "run7", "env", "counter") in said
    assert said.count(("log_metric", "run7", "episode/return", 2.5, 10)) == 2
    assert said[-1] == ("set_terminated", "run7", "FINISHED")


def test_weights_and_biases_itself_keeps_the_rows_of_a_run_and_its_continuation(
    tmp_path, monkeypatch
):
    pytest.importorskip("wandb", reason="wandb is not installed (extra 'wandb')")
    Record = importlib.import_module("wandb.proto.wandb_internal_pb2").Record

    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    config = small(wandb="arm")
    log(tmp_path, config)
    log(tmp_path, config, after=10, rows=[ROW | {"steps": 20}])
    files = sorted(tmp_path.glob("wandb/offline-run-*/*.wandb"))
    found = [Record.FromString(data) for file in files for data in records(file)]
    runs = [r.run for r in found if r.WhichOneof("record_type") == "run"]
    assert {run.run_id for run in runs} == {(tmp_path / "wandb_run").read_text()}
    rows = [r.history for r in found if r.WhichOneof("record_type") == "history"]
    items = [{i.key or i.nested_key[0]: i.value_json for i in h.item} for h in rows]
    assert [item["episode/return"] for item in items] == ["2.5", "2.5"]
    assert sorted(item["_step"] for item in items) == ["10", "20"]


def test_mlflow_itself_keeps_the_rows_of_a_run_and_its_continuation(
    tmp_path, monkeypatch
):
    mlflow = pytest.importorskip(
        "mlflow", reason="mlflow is not installed (extra 'mlflow')"
    )
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path}/tracked.db")
    config = small(mlflow="arm")
    log(tmp_path, config)
    log(tmp_path, config, after=10, rows=[ROW | {"steps": 20}])
    client = mlflow.MlflowClient()
    experiment = client.get_experiment_by_name("arm")
    (run,) = client.search_runs([experiment.experiment_id])
    assert run.info.status == "FINISHED"
    assert run.data.params["env"] == "counter"
    history = client.get_metric_history(run.info.run_id, "episode/return")
    assert [(m.step, m.value) for m in history] == [(10, 2.5), (20, 2.5)]


def test_a_tracker_that_fails_is_left_alone_and_training_goes_on(tmp_path, fake):
    broken = WANDB.replace("self.file.open", "raise ConnectionError('lost')  #", 1)
    fake("wandb", broken)
    rows = [ROW, ROW | {"iteration": 2, "steps": 20}]
    said = log(tmp_path, small(wandb="arm"), rows=rows)
    assert said.count("WeightsAndBiases failed; training goes on: lost") == 1
    steps = [e.step for e in events(tmp_path / "tb") if e.HasField("summary")]
    assert steps == [10, 20]
