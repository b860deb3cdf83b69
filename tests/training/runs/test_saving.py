"""Full disks: what is kept, what is said, and when training stops."""

import errno
import io
import os
import random
import shutil
import subprocess
import sys
from typing import Any

import jax.numpy as jnp
import orbax.checkpoint as ocp
import polars as pl
import pytest
from rich.console import Console

from rmp_mjx.training.runs.checkpoint import Checkpointer, SaveError
from rmp_mjx.training.runs.logging import RunLogger
from rmp_mjx.training.runs.metrics import Row
from rmp_mjx.training.runs.saving import Commands, Saver, TrainingFailure

FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
STATE = {"x": jnp.ones(3)}


@pytest.fixture
def full(monkeypatch):
    """`full(True)`: the disk fills up in the middle of every save."""
    save = ocp.CheckpointManager.save

    def fail(self, step, *args, **kwargs):
        half = self.directory / f"{step}.orbax-checkpoint-tmp"
        half.mkdir()
        (half / "half").write_text("written")
        raise FULL

    def switch(on):
        monkeypatch.setattr(ocp.CheckpointManager, "save", fail if on else save)

    return switch


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_failed_save_leaves_what_was_there_and_nothing_else(tmp_path, full):
    store = Checkpointer(tmp_path / "checkpoints")
    store.save(1, STATE)
    full(True)
    with pytest.raises(SaveError, match=r"checkpoint 2: .*No space left"):
        store.save(2, STATE)
    assert names(tmp_path / "checkpoints") == ["1"]
    full(False)
    store.save(3, STATE)
    assert store.restore(STATE, pytest.fail)[0] == 3
    store.close()


@pytest.fixture
def saver(tmp_path):
    notes = []
    store = Checkpointer(tmp_path / "checkpoints")
    made: Any = Saver(store, tmp_path, notes.append, 0, Commands("train --resume"))
    made.notes = notes
    yield made
    store.close()


def test_a_failed_save_is_tried_again_once_and_then_training_stops(saver, full):
    saver.save(1, STATE, final=False)
    full(True)
    saver.save(2, STATE, final=False)
    (said,) = saver.notes
    assert "NOT SAVED" in said and "No space left" in said and "MiB free" in said
    with pytest.raises(TrainingFailure, match="--resume") as failure:
        saver.save(3, STATE, final=False)
    assert "saved is iteration 1" in str(failure.value)


def test_a_save_that_works_again_is_as_good_as_new(saver, full):
    for iteration, on in enumerate((True, False, True, False), start=1):
        full(on)
        saver.save(iteration, STATE, final=False)
    assert saver.last == 4 and len(saver.notes) == 2


def test_the_last_save_of_a_run_has_no_second_chance(saver, full):
    full(True)
    with pytest.raises(TrainingFailure, match="nothing is saved yet"):
        saver.save(1, STATE, final=True)


def test_a_full_disk_for_logs_is_said_once_and_loses_no_row(tmp_path, monkeypatch):
    write, text = pl.DataFrame.write_parquet, io.StringIO()

    def fail(*args):
        raise FULL

    row: Row = {"time/steps_per_s": 1.0}
    console = Console(file=text, width=200)
    with RunLogger(tmp_path / "m.parquet", {}, 4, console=console) as logger:
        monkeypatch.setattr(pl.DataFrame, "write_parquet", fail)
        for iteration in (1, 2, 3):
            logger.add(row | {"iteration": iteration, "steps": iteration})
            logger.flush()
        monkeypatch.setattr(pl.DataFrame, "write_parquet", write)
        logger.add({"iteration": 4, "steps": 4})
    assert text.getvalue().count("No space left") == 1
    found = pl.read_parquet(tmp_path / "m.parquet")
    assert found["iteration"].to_list() == [1, 2, 3, 4]
    assert names(tmp_path) == ["m.parquet"]


READ_ONLY = """
import sys
from rmp_mjx.training.runs import run_folder
from rmp_mjx.training.config import ConfigError, TrainConfig
from tests.training import toys

try:
    run_folder.open_run(TrainConfig(toys.Options()).replace(run_dir=f"{sys.argv[1]}/run"))
except ConfigError as error:
    sys.stdout.write(str(error))
"""

ON_A_SMALL_DISK = """
import io, sys
from pathlib import Path
from rich.console import Console
from rmp_mjx import runtime
from rmp_mjx.training.runs.saving import Commands
from rmp_mjx.training.runs.checkpoint import Checkpointer
from rmp_mjx.training.runs.saving import TrainingFailure
from tests.training.conftest import run

runtime.configure()
disk, text = Path(sys.argv[1]), io.StringIO()
save = Checkpointer.save

def filling(self, step, *rest):
    filler = disk / "filler"
    if step == 4:
        with filler.open("wb", buffering=0) as file:
            try:
                while file.write(bytes(4096)):
                    pass
            except OSError:
                file.truncate(max(0, file.tell() - int(sys.argv[3])))
    if step == int(sys.argv[2]):
        filler.unlink()
    save(self, step, *rest)

Checkpointer.save = filling
console = Console(file=text, width=300)
try:
    result, _ = run(disk / "run", console, num_timesteps=64 * 10)
    text.write(f"finished {result.iterations}")
except TrainingFailure as failure:
    text.write(f"stopped: {failure}")
names = [path.name for path in (disk / "run/checkpoints").iterdir()]
kept = sorted((name for name in names if name.isdecimal()), key=int)
sys.stdout.write(f"{text.getvalue()}\\nkept {' '.join(kept)}")
"""


@pytest.fixture
def on_disk(root, tmp_path):
    """`on_disk(code, options, *args)`: run code with a file system of its own."""
    space = ["unshare", "--map-root-user", "--mount", "sh", "-c"]

    def run(code, options, *args):
        mount = f"mount -t tmpfs -o {options} none {tmp_path} && exec"
        check = [*space, f"{mount} true"]
        if not shutil.which("unshare") or subprocess.call(
            check, stderr=subprocess.DEVNULL
        ):
            pytest.skip("this machine lets no one mount a file system of their own")
        done = subprocess.run(
            [
                *space,
                f'{mount} "$@"',
                "sh",
                sys.executable,
                "-c",
                code,
                tmp_path,
                *args,
            ],
            cwd=root,
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def test_a_read_only_disk_is_refused(on_disk, tmp_path):
    said = on_disk(READ_ONLY, "ro")
    assert said == f"cannot write to {tmp_path}/run: Read-only file system"


@pytest.mark.parametrize("freed", [6, 99])
def test_training_meets_a_disk_that_is_really_full(on_disk, freed):
    """A file system of 3 MiB fills up before checkpoint 4; freed before 6, or never."""
    said = on_disk(ON_A_SMALL_DISK, "size=3m", str(freed), "0")
    assert said.count("NOT SAVED") == 1
    assert said.count("cannot be written for now") == 1
    if freed == 6:
        assert "finished 10" in said and "kept 6 8 10" in said
    else:
        assert "stopped: iteration 6 is not saved" in said
        assert "saved is iteration 2" in said and said.endswith("kept 2")


@pytest.mark.faults
@pytest.mark.slow
def test_twenty_disks_that_are_nearly_full_leave_a_checkpoint(on_disk):
    """Up to 200 kB are free at checkpoint 4, so that a save fails anywhere in it."""
    chance = random.Random(0)
    for _ in range(20):
        free, freed = chance.randrange(200_000), chance.choice((6, 8, 99))
        said = on_disk(ON_A_SMALL_DISK, "size=3m", str(freed), str(free))
        last = int(said.split()[-1])
        if "finished 10" in said:
            assert last == 10
        else:
            assert "stopped: iteration" in said
            assert f"saved is iteration {last}" in said
