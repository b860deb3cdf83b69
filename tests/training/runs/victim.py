"""A training process to be killed: `python -m tests.training.runs.victim FOLDER [resume]`.

It says on standard output what it is doing, line by line.
"""

import sys
from typing import Any
from pathlib import Path

from rmp_mjx import runtime
from rmp_mjx.training.runs import loop as train_module
from rmp_mjx.training.runs.checkpoint import Checkpointer
from rmp_mjx.training.runs.logging import RunLogger
from tests.training.conftest import SMALL, run

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


def main() -> int:
    runtime.configure()
    speak()
    folder, *resume = sys.argv[1:]
    place = {"run_dir": None, "resume": folder} if resume else {}
    result, _ = run(Path(folder), **{**OPTIONS, **place})
    return result.exit_code


if __name__ == "__main__":
    sys.exit(main())
