"""Processes that tests start: `python -m tests.training.runs.processes ROLE ...`.

`victim FOLDER [resume] [jumping]` says on standard output what it is doing, line by
line, until somebody kills it; `jumping`: its clock is wrong by up to a day, each time
otherwise. `member JSON` trains the counting toy together with others.
"""

import functools
import json
import random
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console

from rmp_mjx import runtime
from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.runs import distributed
from rmp_mjx.training.runs import loop as train_module
from rmp_mjx.training.runs.checkpoint import Checkpointer
from rmp_mjx.training.runs.logging import RunLogger
from rmp_mjx.training.runs.saving import TrainingFailure
from tests.training import toys
from tests.training.conftest import SMALL, run, small

ITERATIONS = 60
OPTIONS = {
    "num_timesteps": SMALL["num_envs"] * SMALL["unroll_length"] * ITERATIONS,
    "checkpoint_interval": 2,
    "keep_every": 10,
}


def say(*words: object) -> None:
    sys.stdout.write(" ".join(map(str, words)) + "\n")
    sys.stdout.flush()


def speak() -> None:
    """Say when an iteration is done, and when a save begins and has succeeded."""
    save, add, start = Checkpointer.save, RunLogger.add, train_module._start

    def spoken_save(self, step, *rest):
        say("saving", step)
        save(self, step, *rest)
        say("saved", step)

    def spoken_add(self, *rows):
        add(self, *rows)
        say("iteration", rows[0]["iteration"])

    def spoken_start(*args):
        state, done = start(*args)
        say("starting", done)
        return state, done

    spied: tuple[Any, Any] = (Checkpointer, RunLogger)
    spied[0].save, spied[1].add = spoken_save, spoken_add
    train_module._start = spoken_start


def jump() -> None:
    """From now on the wall clock is wrong by up to a day either way at every look."""
    real, real_ns = time.time, time.time_ns
    error = functools.partial(random.uniform, -86400.0, 86400.0)
    time.time = lambda: real() + error()
    time.time_ns = lambda: real_ns() + int(1e9 * error())


def victim(folder: str, *how: str) -> int:
    """Train, and say aloud what is done, until somebody kills the process."""
    runtime.configure()
    speak()
    if "jumping" in how:
        jump()
    place = {"run_dir": None, "resume": folder} if "resume" in how else {}
    try:
        result, _ = run(Path(folder), **{**OPTIONS, **place})
    except (ConfigError, TrainingFailure) as error:
        sys.stderr.write(f"{error}\n")
        return 2 if isinstance(error, ConfigError) else 1
    return result.exit_code


def member(options: str) -> int:
    """Train as one of several processes.

    Args:
        options: JSON object of what differs from `conftest.SMALL`, and under `process`
            coordinator, number of this process and number of all (or nulls).
    """
    changes = json.loads(options)
    distributed.join(*changes.pop("process"))
    runtime.configure()
    config = small(**changes)
    folder, lock = distributed.open_run(config)
    with lock:
        return train_module.train(
            toys.Counter(), config, folder, Console(quiet=True)
        ).exit_code


def main() -> int:
    role, *arguments = sys.argv[1:]
    return {"victim": victim, "member": member}[role](*arguments)


if __name__ == "__main__":
    sys.exit(main())
