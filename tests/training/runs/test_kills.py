"""Training processes that are killed at any moment, resumed, and compared."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time

import jax
import polars as pl
import pytest

from rmp_mjx.training.runs import run_folder
from tests.training.conftest import bits, newest_state, run
from tests.training.runs import processes

PATIENCE = 120.0
"""Seconds after which a process that says nothing counts as stuck."""
LONGEST_SAVE = 0.15
"""Seconds: a kill falls anywhere from the beginning of a save to past its end."""


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """An uninterrupted run: its configuration, last state and rows."""
    folder = tmp_path_factory.mktemp("kills") / "reference"
    _, config = run(folder, **processes.OPTIONS)
    return config, last_state(folder, config), rows(folder)


def last_state(folder, config):
    step, state = newest_state(folder, config)
    return step, jax.tree.map(bits, state)


def rows(folder):
    table = pl.read_parquet(folder / run_folder.METRICS)
    return table.select(pl.exclude("^time/.*$"))


class Victim:
    """A training process; its lines can be waited for."""

    def __init__(self, root, folder, *how):
        self.root, self.folder = root, folder
        self.heard: list[tuple[str, int]] = []
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "tests.training.runs.processes",
                "victim",
                str(folder),
                *how,
            ],
            cwd=root,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def _hear(self, line):
        said, _, number = line.strip().partition(" ")
        if number.isdecimal():  # libraries talk too
            self.heard.append((said, int(number)))

    def wait_for(self, word, at_least=0):
        """Read on to `word N` with N at least this; False if it ends before."""
        for line in self._process.stdout or ():
            self._hear(line)
            if any(w == word and n >= at_least for w, n in self.heard[-1:]):
                return True
        return False

    def last(self, word):
        return max((n for said, n in self.heard if said == word), default=0)

    def send(self, number):
        self._process.send_signal(number)

    def end(self):
        """Exit code and error output; what was said until then is heard."""
        out, err = self._process.communicate(timeout=PATIENCE)
        for line in out.splitlines():
            self._hear(line)
        return self._process.returncode, err


def kill(process, chance):
    """SIGKILL."""
    process.send(signal.SIGKILL)
    assert process.end()[0] == -signal.SIGKILL


def terminate_twice(process, chance):
    """SIGTERM, and again within 0.1 s: the end of the process, orderly or not."""
    process.send(signal.SIGTERM)
    time.sleep(chance.uniform(0.0, 0.1))
    process.send(signal.SIGTERM)
    assert process.end()[0] in (-signal.SIGTERM, 128 + signal.SIGTERM)


def intrude(process, chance):
    """A second process is refused as long as the first lives; then SIGKILL for it."""
    process.send(signal.SIGSTOP)
    code, error = Victim(process.root, process.folder, "resume").end()
    assert (code, error.count("is in use by process")) == (2, 1), error
    kill(process, chance)


def kill_and_resume(root, folder, reference, kills, chance, strike=kill, how=()):
    """Strike the same run again and again; how many strikes fell into a save."""
    config, state, table = reference
    acknowledged, resume, saving = 0, [], 0
    for _ in range(kills):
        process = Victim(root, folder, *resume, *how)
        assert process.wait_for("starting"), process.end()
        # never less than what a process before has reported as saved
        assert process.last("starting") >= acknowledged
        within = chance.choice(("saving", "iteration"))
        target = process.last("starting") + chance.randint(3, 7)
        assert process.wait_for(within, target), process.end()
        time.sleep(chance.uniform(0.0, LONGEST_SAVE))
        strike(process, chance)
        saving += process.last("saving") > process.last("saved")
        acknowledged, resume = max(acknowledged, process.last("saved")), ["resume"]
    process = Victim(root, folder, *resume, *how)
    code, error = process.end()
    assert code == 0, error
    assert process.last("starting") >= acknowledged
    assert last_state(folder, config) == state
    assert rows(folder).equals(table)
    names = [p.name for p in (folder / run_folder.CHECKPOINTS).iterdir()]
    assert all(name.isdecimal() for name in names), f"left behind: {names}"
    return saving


def test_a_run_killed_twice_ends_as_if_nothing_had_happened(root, reference, tmp_path):
    kill_and_resume(root, tmp_path / "run", reference, 2, random.Random(0))


@pytest.mark.parametrize(
    ("strike", "how"),
    [(terminate_twice, ()), (intrude, ()), (kill, ("jumping",))],
    ids=["terminated twice", "with a second process", "with a clock that jumps"],
)
@pytest.mark.faults
@pytest.mark.slow
def test_twenty_strikes_of_other_kinds_lose_nothing_either(
    root, reference, tmp_path, strike, how
):
    for k in range(4):
        folder, chance = tmp_path / str(k), random.Random(k)
        kill_and_resume(root, folder, reference, 5, chance, strike, how)


def removed(root, folder, chance):
    """A process whose run's folder is deleted; its exit code and errors."""
    process = Victim(root, folder)
    within = chance.choice(("saving", "iteration"))
    assert process.wait_for(within, chance.randint(3, 7)), process.end()
    time.sleep(chance.uniform(0.0, LONGEST_SAVE))
    shutil.rmtree(folder, ignore_errors=True)
    return process.end()


def test_a_run_whose_folder_is_removed_stops_and_says_so(root, tmp_path):
    code, error = removed(root, tmp_path / "run", random.Random(0))
    assert code == 1 and "was removed or replaced while" in error


@pytest.mark.faults
@pytest.mark.slow
def test_twenty_runs_whose_folder_is_removed_stop_and_say_so(root, tmp_path):
    for k in range(20):
        code, error = removed(root, tmp_path / str(k), random.Random(k))
        assert code == 1 and "was removed or replaced while" in error


@pytest.mark.faults
@pytest.mark.slow
def test_a_run_killed_twenty_times_ends_as_if_nothing_had_happened(
    root, reference, tmp_path, capsys
):
    kills = int(os.environ.get("RMP_MJX_KILLS", "20"))
    done = saving = 0
    while done < kills:  # a run has room for eight kills
        some = min(8, kills - done)
        folder = tmp_path / str(done)
        saving += kill_and_resume(root, folder, reference, some, random.Random(done))
        done += some
    with capsys.disabled():
        sys.stdout.write(f"{kills} kills, {saving} of them during a save\n")
    assert saving > 0


def test_a_terminated_process_saves_says_how_to_resume_and_exits_with_143(
    root, tmp_path
):
    process = Victim(root, tmp_path / "run")
    assert process.wait_for("iteration", 3), process.end()
    process.send(signal.SIGTERM)
    code, error = process.end()
    assert code == 128 + signal.SIGTERM
    assert "stopping after this iteration" in error
    assert process.last("saved") == process.last("iteration") < processes.ITERATIONS
