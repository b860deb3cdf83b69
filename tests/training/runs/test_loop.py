"""The training loop: what it writes, interruption, resumption, failure."""

import io
import json
import os
import shutil
import signal

import jax
import numpy as np
import polars as pl
import pytest
from rich.console import Console

from rmp_mjx.training import demonstrations
from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.demonstrations import Demonstrations
from rmp_mjx.training.records import config_of, read_record
from rmp_mjx.training.runs import loop as train_module
from rmp_mjx.training.runs import run_folder
from rmp_mjx.training.runs.logging import RunLogger
from rmp_mjx.training.runs.policies import load_agent
from rmp_mjx.training.runs.saving import StopRequest
from tests.training import toys
from tests.training.conftest import ITERATIONS, bits, newest_state, run, small


def test_a_run_leaves_its_configuration_versions_metrics_and_checkpoints(finished):
    folder, result, config = finished
    assert (result.iterations, result.exit_code) == (ITERATIONS, 0)
    assert (
        config_of(
            read_record(folder / run_folder.CONFIG), lambda task: toys.Options(**task)
        )
        == config
    )
    (versions,) = json.loads((folder / run_folder.VERSIONS).read_text())
    assert {"python", "jax", "brax", "mujoco", "device", "command"} <= set(versions)
    rows = pl.read_parquet(folder / run_folder.METRICS)
    assert rows["iteration"].to_list() == [1, 2, 3, 4]
    assert rows["steps"].to_list() == [64, 128, 192, 256]
    assert list((folder / run_folder.TENSORBOARD).glob("events*"))
    assert newest_state(folder, config)[0] == ITERATIONS


def test_a_run_from_demonstrations_keeps_them_and_resumes_bit_identically(tmp_path):
    file, toy = tmp_path / "demos.parquet", toys.Counter()
    rng = np.random.default_rng(0)
    rows = {
        "episode": np.zeros(9, int),
        "step": np.arange(9),
        "observation": rng.normal(size=(9, 3)),
        "action": rng.uniform(-1.0, 1.0, (9, 1)),
        "reward": np.zeros(9),
        "done": np.zeros(9, bool),
        "success": np.zeros(9, bool),
    }
    about = demonstrations.describe(toy, "a test")
    demonstrations.write(file, Demonstrations(**rows, about=about))
    whole, half = tmp_path / "whole", tmp_path / "half"
    _, config = run(whole, demos=str(file))
    run(half, demos=str(file), num_timesteps=config.ppo.steps_per_iteration * 2)
    copied = (whole / run_folder.DEMOS).read_bytes()
    assert copied == file.read_bytes()
    file.unlink()  # the run has its own
    run(half, run_dir=None, resume=str(half), demos=str(file))
    for one, two in zip(
        *(jax.tree.leaves(newest_state(f, config)[1]) for f in (whole, half)),
        strict=True,
    ):
        assert bits(one) == bits(two)
    with pytest.raises(ConfigError, match="no file of demonstrations"):
        run(tmp_path / "other", demos=str(file))


def test_a_terminated_and_resumed_run_is_bit_identical(finished, tmp_path, monkeypatch):
    folder, _, config = finished
    add = RunLogger.add

    def terminate_at_three(self, row):
        add(self, row)
        if row["iteration"] == 3:
            os.kill(os.getpid(), signal.SIGTERM)

    other, said = tmp_path / "interrupted", io.StringIO()
    with monkeypatch.context() as patch:
        patch.setattr(RunLogger, "add", terminate_at_three)
        stopped, _ = run(other, Console(file=said, width=200))
    assert (stopped.iterations, stopped.exit_code) == (3, 128 + signal.SIGTERM)
    assert f"--resume {other}" in said.getvalue()
    assert newest_state(other, config)[0] == 3

    resumed, _ = run(other, run_dir=None, resume=str(other))
    assert (resumed.iterations, resumed.exit_code) == (ITERATIONS, 0)
    step, state = newest_state(other, config)
    reference_step, reference = newest_state(folder, config)
    assert step == reference_step
    for one, two in zip(
        jax.tree.leaves(state), jax.tree.leaves(reference), strict=True
    ):
        assert bits(one) == bits(two)
    rows, reference = (
        pl.read_parquet(f / run_folder.METRICS).select(pl.exclude("^time/.*$"))
        for f in (other, folder)
    )
    assert rows.equals(reference)
    assert len(json.loads((other / run_folder.VERSIONS).read_text())) == 2


def test_resuming_a_finished_run_says_so_and_changes_nothing(finished):
    folder, _, config = finished
    before = newest_state(folder, config)
    said = io.StringIO()
    result, _ = run(
        folder, Console(file=said, width=200), run_dir=None, resume=str(folder)
    )
    assert result.had_finished
    assert "has finished" in said.getvalue()
    after = newest_state(folder, config)
    assert before[0] == after[0]
    assert jax.tree.map(bits, before[1]) == jax.tree.map(bits, after[1])


def test_a_run_that_becomes_nonfinite_stops_and_names_the_checkpoints(tmp_path):
    class Broken(toys.Counter):
        def step(self, state, action):
            return super().step(state, action).replace(reward=jax.numpy.nan)

    config = small(num_timesteps=128, run_dir=str(tmp_path / "bad"))
    folder, lock = run_folder.open_run(config)
    with lock, pytest.raises(train_module.TrainingFailure, match="non-finite"):
        train_module.train(Broken(), config, folder, Console(quiet=True))
    assert not list((folder / run_folder.CHECKPOINTS).glob("[0-9]*"))


@pytest.mark.parametrize("first", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_of_either_kind_meets_the_default_handler(first):
    before = signal.getsignal(signal.SIGINT)
    with StopRequest() as stop:
        os.kill(os.getpid(), first)
        for number in (signal.SIGINT, signal.SIGTERM):
            assert signal.getsignal(number) is signal.SIG_DFL
    assert stop.exit_code == 128 + first
    assert signal.getsignal(signal.SIGINT) is before


def copy_of(finished, tmp_path):
    """A finished run to spoil."""
    folder = tmp_path / "copy"
    shutil.copytree(finished[0], folder)
    return folder


def resume(folder, **changes):
    said = io.StringIO()
    console = Console(file=said, width=200)
    result, config = run(folder, console, run_dir=None, resume=str(folder), **changes)
    return result, config, said.getvalue()


def test_a_run_that_was_killed_before_its_first_save_begins_anew(finished, tmp_path):
    folder = copy_of(finished, tmp_path)
    shutil.rmtree(folder / run_folder.CHECKPOINTS)
    result, config, said = resume(folder)
    assert "has no checkpoint yet and begins anew" in said
    assert "training on " in said
    assert result.iterations == ITERATIONS
    one, two = (newest_state(f, config)[1] for f in (folder, finished[0]))
    assert jax.tree.map(bits, one) == jax.tree.map(bits, two)
    rows = pl.read_parquet(folder / run_folder.METRICS)
    assert rows["iteration"].to_list() == [1, 2, 3, 4]


def test_damaged_metrics_are_begun_anew_and_the_run_goes_on(finished, tmp_path):
    folder = copy_of(finished, tmp_path)
    (folder / run_folder.METRICS).write_bytes(b"no parquet")
    steps = 64 * (ITERATIONS + 1)
    result, _, said = resume(folder, num_timesteps=steps)
    assert "cannot be read and is begun anew" in said
    assert result.iterations == ITERATIONS + 1
    assert pl.read_parquet(folder / run_folder.METRICS)["iteration"].to_list() == [5]


def test_a_run_goes_on_with_what_it_was_trained_with_unless_told(finished, tmp_path):
    folder = copy_of(finished, tmp_path)
    path = folder / run_folder.VERSIONS
    versions, *_ = json.loads(path.read_text())
    path.write_text(json.dumps([versions | {"brax": "0.0.1", "device": "an abacus"}]))
    with pytest.raises(ConfigError, match=r"brax 0\.0\.1 -> .*; --allow_changes"):
        resume(folder)
    result, _, said = resume(folder, allow_changes=True)
    assert result.had_finished
    assert "not an exact continuation: brax 0.0.1" in said and "an abacus" in said


def test_the_policy_of_any_kept_checkpoint_can_be_read(finished):
    folder, _, config = finished
    obs = jax.numpy.ones((1, 3))
    actions = {}
    for which in ("newest", "best", "2", "4"):
        iteration, agent = load_agent(
            toys.Counter(), config, folder, True, pytest.fail, checkpoint=which
        )
        actions[which] = iteration, float(agent(obs, jax.random.key(0))[0, 0])
    assert actions["newest"] == actions["4"]
    assert actions["best"] in (actions["2"], actions["4"])
    assert actions["2"] != actions["4"]


def test_resuming_with_another_configuration_names_the_fields(finished):
    folder, _, config = finished
    changed = config.replace(resume=str(folder), run_dir=None, num_envs=16)
    with pytest.raises(ConfigError, match=r"num_envs: 8 -> 16"):
        run_folder.open_run(changed)
