"""The same run on one device, on four, and on two processes with two each."""

import json
import os
import socket
import subprocess
import sys

import jax
import numpy as np
import polars as pl
import pytest

from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.runs import distributed, run_folder
from tests.training.conftest import ITERATIONS, SMALL, newest_state, run

PATIENCE = 150
"""Seconds after which a process counts as stuck; they take about 20."""


def start(root, devices, **asked):
    """A process with so many CPU devices that trains the counting toy."""
    flags = f"--xla_force_host_platform_device_count={devices}"
    return subprocess.Popen(
        [
            sys.executable,
            "-m",
            "tests.training.runs.processes",
            "member",
            json.dumps(asked),
        ],
        cwd=root,
        env={**os.environ, "XLA_FLAGS": flags},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(processes):
    """What they said; none outlives this."""
    try:
        said = [process.communicate(timeout=PATIENCE)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.wait()
    codes = [process.returncode for process in processes]
    return codes, "\n".join(said)


LISTENS = """
import pathlib, sys
from rmp_mjx.training.runs import distributed
port = int(sys.argv[1])
distributed.join(f"127.0.0.1:{port}", 0, 1)
for table in ("tcp", "tcp6"):
    for line in pathlib.Path("/proc/net", table).read_text().splitlines()[1:]:
        address, state = line.split()[1], line.split()[3]
        if state == "0A" and int(address.split(":")[1], 16) == port:
            print("listens", address.split(":")[0])
"""
"""Says on which addresses process 0 listens."""


@pytest.mark.skipif(sys.platform != "linux", reason="reads the tables of Linux")
def test_process_0_listens_on_the_host_it_was_given_alone(root):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    done = subprocess.run(
        [sys.executable, "-c", LISTENS, str(port)],
        cwd=root,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=True,
    )
    heard = [line.split()[1] for line in done.stdout.splitlines() if "listens" in line]
    # 127.0.0.1 in the byte order of the tables, as IPv4 or as IPv6's form of it
    assert heard and all(host.endswith("0100007F") for host in heard)


def steps(iterations):
    return SMALL["num_envs"] * SMALL["unroll_length"] * iterations


def assert_same_run(folder, reference, config):
    """States and metrics agree.

    Parameters and statistics are float32 sums in another order, through 16 steps of
    Adam, each of which may blow a rounding error up to a thousandth of its step of
    1e-3: 1e-5. Keys, counters and environments, which need no sum, agree exactly.
    """
    (step, mine), (wanted, theirs) = (
        newest_state(f, config) for f in (folder, reference)
    )
    assert step == wanted == ITERATIONS
    for one, two in zip(
        jax.tree.leaves((mine.key, mine.iteration, mine.rollout.env_state.data)),
        jax.tree.leaves((theirs.key, theirs.iteration, theirs.rollout.env_state.data)),
        strict=True,
    ):
        assert (one == two).all()
    pairs = zip(
        jax.tree.leaves((mine.learner, mine.normalizer, mine.scale)),
        jax.tree.leaves((theirs.learner, theirs.normalizer, theirs.scale)),
        strict=True,
    )
    for one, two in pairs:
        np.testing.assert_allclose(
            np.asarray(one, float), np.asarray(two, float), rtol=1e-5, atol=1e-5
        )
    rows, others = (
        pl.read_parquet(f / run_folder.METRICS).select(
            "iteration", "^episode/.*$", "nonfinite_envs"
        )
        for f in (folder, reference)
    )
    assert rows["iteration"].to_list() == list(range(1, ITERATIONS + 1))
    np.testing.assert_allclose(rows.to_numpy(), others.to_numpy(), rtol=1e-5)


def test_four_devices_train_as_one_does(root, finished, tmp_path):
    reference, _, config = finished
    folder = tmp_path / "four"
    member = start(
        root,
        4,
        run_dir=str(folder),
        num_timesteps=steps(ITERATIONS),
        process=(None, None, None),
    )
    codes, said = finish([member])
    assert codes == [0], said
    (versions,) = json.loads((folder / run_folder.VERSIONS).read_text())
    assert versions["device"].startswith("4 x ")
    assert_same_run(folder, reference, config)


def test_two_processes_train_as_one_does_and_one_continues_their_run(
    root, finished, tmp_path
):
    reference, _, config = finished
    folder = tmp_path / "two"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        coordinator = f"127.0.0.1:{probe.getsockname()[1]}"
    members = [
        start(
            root,
            2,
            run_dir=str(folder),
            num_timesteps=steps(ITERATIONS // 2),
            process=(coordinator, number, 2),
        )
        for number in range(2)
    ]
    codes, said = finish(members)
    assert codes == [0, 0], said
    (versions,) = json.loads((folder / run_folder.VERSIONS).read_text())
    assert versions["device"].startswith("4 x ")
    run(folder, run_dir=None, resume=str(folder))
    assert_same_run(folder, reference, config)


@pytest.mark.parametrize(
    ("process", "message"),
    [
        ((None, 0, 2), "need --coordinator"),
        (("host:1", None, 2), "needs --process_id"),
        (("host", 0, 2), "HOST:PORT"),
        (("host:1", 2, 2), r"0 \.\. 1, is 2"),
    ],
)
def test_processes_that_cannot_meet_are_told_why(process, message):
    with pytest.raises(ConfigError, match=message):
        distributed.join(*process)
