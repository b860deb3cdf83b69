"""Train a policy: `train.py`, and `rmp-mjx-train` where this is installed."""

import contextlib
import importlib.util
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from rmp_mjx import RobotError, runtime, sim
from rmp_mjx.training import demonstrations
from rmp_mjx.training.config import ConfigError, TrainConfig
from rmp_mjx.training.evaluation import evaluate
from rmp_mjx.training.runs import distributed, run_folder
from rmp_mjx.training.runs.checkpoint import CheckpointError
from rmp_mjx.training.runs.loop import TrainingFailure, TrainResult, train
from rmp_mjx.training.runs.saving import Commands

from . import cli, grid, registry, results
from .flags import typed

FAILURES = (CheckpointError, TrainingFailure, ConfigError, RobotError, OSError)
"""What ends a run with a message."""


def learn(env, config: TrainConfig, folder, console: Console) -> TrainResult:
    """Train with the trainer that the configuration names."""
    if config.trainer == "ours":
        again, replay = (
            typed(name, "env", config.task.env) for name in ("train", "replay")
        )
        commands = Commands(resume=f"{again} --resume", replay=replay)
        return train(env, config, folder, console, commands)
    from rmp_mjx.training.brax import trainer  # loads all of Brax's environments

    return trainer.train(env, config, folder, console)


def run(config: TrainConfig, console: Console, watched: bool = False) -> int:
    """Train and evaluate one configuration; returns the exit code.

    Args:
        config: Configuration.
        console: Terminal.
        watched: Whether to show a live view of it.
    """
    try:
        folder, lock = distributed.open_run(config)
    except ConfigError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    with lock, view_of(folder, config, console, watched):
        runtime.configure(split_cpu=distributed.alone())
        try:
            env = registry.make(config.task)
            evaluate.check_size(env, config.run.eval_episodes)
            result = learn(env, config, folder, console)
            complete = result.had_finished and results.are_complete(config, folder)
            if not result.exit_code and not complete:
                results.finish(env, result, config, folder, console)
        except FAILURES as error:
            if distributed.is_primary():
                run_folder.discard(folder)
            print(f"error: {error}", file=sys.stderr)
            return 2 if isinstance(error, (ConfigError, RobotError)) else 1
        return result.exit_code


def check_watch(grid: bool) -> None:
    """Refuse a live view that cannot be.

    Raises:
        ConfigError: Of a grid, or without the extra.
    """
    if grid:
        raise ConfigError("--watch shows one run: leave it out for a grid")
    if importlib.util.find_spec("viser") is None:
        raise ConfigError("--watch needs an extra: pip install 'rmp-mjx[viewer]'")


def view_of(folder: Path, config: TrainConfig, console: Console, watched: bool) -> Any:
    """The live view of a run, as a context; the primary process has it."""
    if not watched or not distributed.is_primary():
        return contextlib.nullcontext()
    from .watch import watching  # needs an extra

    return watching(folder, config, console)


def main(args: Sequence[str] | None = None) -> int:
    """Parse, check, train, evaluate; returns the exit code."""
    console = Console()
    try:
        options, wanted = cli.parse_train(args)
        configs = list(wanted.cells().values()) if wanted else [options.config]
        if options.watch:
            check_watch(wanted is not None)
        for config in configs:
            sim.require(config.task.physics)
            if config.ppo.demos is not None and not config.run.resume:
                demonstrations.read(Path(config.ppo.demos))
        distributed.join(**vars(options.processes))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if not distributed.alone():
        runtime.configure()
        console = Console(quiet=not distributed.is_primary())
    if wanted:
        return grid.run(wanted, partial(run, console=console), console)
    return run(configs[0], console, options.watch)


if __name__ == "__main__":
    sys.exit(main())
