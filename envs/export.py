"""A checkpoint's policy as one file: `python -m envs.export RUN FILE`.

A run that finishes writes the file of its last policy itself.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from rmp_mjx import runtime
from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.policy import save_policy
from rmp_mjx.training.runs import policies
from rmp_mjx.training.runs.checkpoint import NEWEST, CheckpointError

from . import registry
from .flags import load_config, parse


@dataclass(frozen=True)
class ExportOptions:
    """Write a policy of a run as one file."""

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    file: Annotated[Path, tyro.conf.Positional]
    """File to write, NAME.safetensors; must not exist yet."""
    checkpoint: str = NEWEST
    """Which checkpoint of the run: newest, best (by the success, then the return, of
    training's episodes), or an iteration's number."""
    seed_index: int = 0
    """Which agent of a run that trained several seeds, from 0."""
    env: str | None = None
    """The run's task, if it is a module:Class."""


def export(options: ExportOptions, note: Callable[[str], None]) -> None:
    """Write the file.

    Args:
        options: What to write.
        note: Called with one line for each damaged checkpoint.

    Raises:
        ConfigError: There is no such run or seed, or the file has another suffix or
            exists.
        CheckpointError: There is no such checkpoint.
    """
    run, file, k = options.run, options.file, options.seed_index
    if file.suffix != policies.SUFFIX:
        raise ConfigError(f"{file}: a policy file is called NAME{policies.SUFFIX}")
    if file.exists():
        raise ConfigError(f"{file} exists already: delete it, or name another file")
    if not file.parent.is_dir():
        raise ConfigError(f"{file}: there is no folder {file.parent}")
    if options.env:
        registry.task(options.env)
    config = load_config(run)
    if not 0 <= k < config.ppo.num_seeds:
        raise ConfigError(f"seed_index must lie in 0 .. {config.ppo.num_seeds - 1}")
    env = registry.make(config.task)
    iterations, agent = policies.load_agent(
        env, config, run, True, note, k, options.checkpoint
    )
    save_policy(file, agent, policies.describe(config, k, run, iterations, None))


def main(args: Sequence[str] | None = None) -> int:
    """Parse and export; returns the exit code."""
    say = partial(Console().print, markup=False, highlight=False, soft_wrap=True)
    try:
        options = parse(ExportOptions, args)
        runtime.configure()
        export(options, say)
    except (ValueError, OSError, CheckpointError) as error:
        Console(stderr=True).print(f"error: {error}", markup=False, soft_wrap=True)
        return 1 if isinstance(error, CheckpointError) else 2
    say(f"written: {options.file}, {options.file.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
