import json
import time

import jax.numpy as jnp
import pytest

from benchmarks import common
from benchmarks.speed import bench_controller, bench_training
from envs.cli import make_config


@pytest.fixture(scope="module")
def timing():
    return common.measure(lambda x: x @ x, jnp.eye(8), seconds=0.0, min_calls=7)


def test_timing_counts_calls_and_compile_apart(timing):
    assert timing.compile_s > 0
    assert 0 < timing.median <= timing.p99


def test_a_function_slower_than_its_budget_is_called_once(timing):
    assert len(timing.calls_s) == 1  # a budget of zero seconds


def test_a_written_file_holds_rows_and_what_is_needed_to_repeat_them(tmp_path):
    file = tmp_path / "new" / "rows.json"
    common.write_json(file, [common.Row("speed", 2.0, "1/s", "a note")], seed=3)
    document = json.loads(file.read_text())
    assert document["rows"] == [
        {"key": "speed", "value": 2.0, "unit": "1/s", "note": "a note"}
    ]
    assert document["settings"] == {"seed": 3}
    assert {"cpu", "cores", "devices", "versions", "git"} <= document["machine"].keys()
    assert document["command"] and document["date"]


def test_default_flag_rows_come_from_a_process_without_the_flags(tmp_path, monkeypatch):
    worker = tmp_path / "worker.py"
    worker.write_text(
        "import json, os\n"
        "row = {'key': 'n', 'unit': '', 'note': os.environ.get('XLA_FLAGS', 'none')}\n"
        "print('noise')\n"
        "print(json.dumps([row | {'value': 1.0}]))\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=1")
    (row,) = common.rows_with_default_flags("worker", [])
    assert row == common.Row("n_default_flags", 1.0, "", "none")


def test_a_failing_worker_says_why(tmp_path, monkeypatch):
    (tmp_path / "broken.py").write_text("raise SystemExit('no such thing')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(RuntimeError, match="no such thing"):
        common.rows_with_default_flags("broken", [])


def test_benchmark_states_are_reproducible_and_inside_the_limits():
    import rmp_mjx as rmp

    robot = rmp.Robot.load("jaco2")
    q, _, _, obstacles = bench_controller.random_states(robot, 16, seed=1)
    again, *_ = bench_controller.random_states(robot, 16, seed=1)
    assert (q == again).all()
    assert ((q > robot.q_lower) & (q < robot.q_upper)).all()
    assert int(obstacles.spheres.active.sum()) == bench_controller.SPHERES


@pytest.mark.slow
def test_a_process_that_is_to_take_the_first_step_prints_its_seconds(
    monkeypatch, capsys
):
    small = {"num_envs": 8, "unroll_length": 4, "num_minibatches": 2}
    monkeypatch.setattr(
        bench_training,
        "make_config",
        lambda **given: make_config(**small, **given),
    )
    bench_training.main(["--first_step", str(time.time())])
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) > 0
