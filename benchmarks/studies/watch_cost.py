"""What does `train.py --watch` cost the training?

A training's iterations are timed while the page of a run, held as if a browser had it
open, plays and draws on the same cores, and while it is stopped, in turns. Run as
``python -m benchmarks.watch_cost --json FILE``, on an idle machine.
"""

from __future__ import annotations

import argparse
import itertools
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from benchmarks.common import ROOT, Row, show, write_json
from benchmarks.speed.bench_training import WARM_UP, iterations
from envs.cli import make_config
from rmp_mjx import runtime

TURN = 8
"""Iterations of a turn; its first is not timed."""
START = 20.0
"""Processor time after which the page has imported and compiled all it needs [s]."""
TASK = "trajectory"
"""The task: that of `bench_training`'s iterations."""
PORT = 8791
"""Where the page is; the next free one if it is taken."""


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(description="What a watched training costs.")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--turns", type=int, default=20, help="of either kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--page", type=Path, help=argparse.SUPPRESS)
    return parser.parse_args(argv)


def play(run: Path) -> None:
    """Be the page of a run that a browser has open, until this process is killed."""
    from envs import watch

    watch.WatchPage.watched = lambda self: True
    flags = ["--run", str(run), "--env", TASK]
    page = watch.page(flags, PORT, run / "recordings")
    assert page is not None  # only with a leash
    page.run(None)


@contextmanager
def playing(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A short run, and a process with its page."""
    run = folder / "run"
    train = [sys.executable, "train.py", "--env", TASK, "--run_dir", str(run)]
    small = ["--num_timesteps", "20000", "--eval_episodes", "0", "--no-video"]
    module = [sys.executable, "-m", "benchmarks.watch_cost", "--page", str(run)]
    with (folder / "log").open("wb") as log:
        subprocess.run([*train, *small], cwd=ROOT, check=True, stdout=log)
        page = subprocess.Popen(module, cwd=ROOT, stdout=log)
        try:
            yield page
        finally:
            page.kill()
            page.wait()


def processor_time(page: subprocess.Popen[bytes]) -> float:
    """Processor time of a process so far [s]."""
    fields = Path(f"/proc/{page.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(page: subprocess.Popen[bytes], turns: int, seed: int) -> list[Row]:
    """Time iterations, the page playing or stopped in turns.

    Raises:
        RuntimeError: The page ended before it played.
    """
    times = iterations(make_config(seed=seed))
    list(itertools.islice(times, WARM_UP))
    while processor_time(page) < START:
        if page.poll() is not None:
            raise RuntimeError(f"the page ended with exit code {page.returncode}")
        next(times)
    found: dict[bool, list[float]] = {True: [], False: []}
    spent = played = 0.0
    for turn in range(2 * turns):
        plays = turn % 2 == 0
        page.send_signal(signal.SIGCONT if plays else signal.SIGSTOP)
        before, began = processor_time(page), time.perf_counter()
        timed = list(itertools.islice(times, TURN))[1:]
        found[plays] += [gather + learn for gather, learn in timed]
        spent += processor_time(page) - before
        played += (time.perf_counter() - began) * plays
    with_page, without = (np.array(found[plays]) for plays in (True, False))
    note = f"{len(with_page)} iterations of {np.median(without):.3f} s each"
    share = f"of one core, {played:.0f} s in which it played"
    return [
        Row("cost_of_watching_median", _cost(np.median, with_page, without), "%", note),
        Row("cost_of_watching_mean", _cost(np.mean, with_page, without), "%", note),
        Row("page_processor_share", 100.0 * spent / played, "%", share),
    ]


def _cost(middle, with_page: np.ndarray, without: np.ndarray) -> float:
    """How much longer iterations take with the page [%]."""
    return 100.0 * float(middle(with_page) / middle(without) - 1.0)


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, print, and write the requested file."""
    args = parse(argv)
    if args.page:
        play(args.page)
        return
    runtime.configure(split_cpu=True)
    with tempfile.TemporaryDirectory() as folder, playing(Path(folder)) as page:
        rows = measure(page, args.turns, args.seed)
    show(rows, "A training that is watched")
    if args.json:
        write_json(args.json, rows, seed=args.seed, turns=args.turns, task=TASK)


if __name__ == "__main__":
    main()
