"""Flags of the command line, typed by the task that is named.

Parsing takes two steps: `--env` (or the run that is named) says which task, and the
task's options are then flags like any others.
"""

import argparse
import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from rmp_mjx.fields import arguments, check
from rmp_mjx.training.config import ConfigError, TrainConfig
from rmp_mjx.training.policy import is_policy, load_policy
from rmp_mjx.training.records import config_of, read_record
from rmp_mjx.training.runs.run_folder import CONFIG

from . import outside, registry
from .options import Options

DEFAULT = "trajectory"
"""Task where none is named."""

Task = TypeVar("Task", bound=Options)
Parsed = TypeVar("Parsed")
EnvName = Annotated[
    str,
    tyro.conf.arg(metavar="{" + ",".join([*registry.names(), "module:Class"]) + "}"),
]


@dataclasses.dataclass(frozen=True)
class Processes:
    """Several processes that train one run together."""

    coordinator: str | None = None
    """HOST:PORT of process 0; under Slurm's srun these three are found out."""
    process_id: int | None = None
    """Number of this process, from 0."""
    num_processes: int | None = None
    """Number of processes."""

    def __post_init__(self):
        """Check the values.

        Raises:
            ConfigError: An option has no such value.
        """
        check(self, ConfigError)


@dataclasses.dataclass(frozen=True)
class TrainOptions(TrainConfig[Task]):
    """Train a policy with PPO (Schulman et al., 2017), or a grid of policies."""

    env: EnvName = DEFAULT
    """Task to learn. Its own options are below; `--env NAME --help` shows another's."""
    envs: str | None = None
    """Tasks of a grid, joined by commas: one run for each of them and each of
    `controllers`, one after the other."""
    controllers: str | None = None
    """Controllers of a grid, joined by commas."""
    watch: bool = False
    """Show a live view of one environment and the curves in the browser, with what the
    training leaves of the processor (needs the extra `viewer`)."""
    processes: Processes = Processes()
    """Several processes that train one run together."""

    @property
    def config(self) -> TrainConfig[Task]:
        """The options of a run."""
        return TrainConfig(self.task, self.ppo, self.run, self.trainer)


def train_flags(
    env: str,
    args: Sequence[str] | None,
    saved: TrainConfig | None = None,
    quiet: bool = False,
) -> TrainOptions:
    """Parse the flags of a training run; what is not given is as it was saved."""
    kind = registry.task(env).Options
    config = saved or TrainConfig(kind())
    run = dataclasses.replace(
        config.run, resume=None, run_dir=None, overwrite=False, allow_changes=False
    )
    default = TrainOptions(config.task, config.ppo, run, config.trainer, env=env)
    return parse(TrainOptions[kind], args, default, env, quiet)


def parse(
    kind: type[Parsed],
    args: Sequence[str] | None,
    default: Any = None,
    env: str = "",
    quiet: bool = False,
) -> Parsed:
    """Parse flags into a dataclass; `--num_envs` and `--num-envs` are the same.

    Exits with code 2 and a message where the flags are wrong.

    Args:
        kind: The dataclass.
        args: Command line; None: this process's.
        default: What is not given.
        env: Task whose options they are, for the messages.
        quiet: Exit without a message.

    Raises:
        ValueError: A value is empty.
    """
    given = {} if default is None else {"default": default}
    script = Path(sys.argv[0]).name
    return tyro.cli(
        tyro.conf.OmitArgPrefixes[kind],
        prog=f"{script} --env {env}" if env else None,
        args=arguments(args),
        use_underscores=True,
        console_outputs=not quiet,
        **given,
    )


PROGRAMS = {"train": "python train.py", "replay": "python -m envs.replay"}
"""Commands in a checkout."""
INSTALLED = "rmp-mjx-"
"""How their names begin where they are installed."""


def typed(command: str, flag: str = "env", *tasks: str) -> str:
    """What to type for a command; it names the tasks that no file may import.

    Args:
        command: train or replay.
        flag: The flag that names tasks.
        *tasks: The tasks that the command meets.
    """
    installed = Path(sys.argv[0]).name.startswith(INSTALLED)
    program = INSTALLED + command if installed else PROGRAMS[command]
    outside_tasks = any(map(outside.is_path, tasks))
    return f"{program} --{flag} {','.join(tasks)}" if outside_tasks else program


def named(args: Sequence[str] | None, *names: str) -> dict[str, str | None]:
    """Values of the flags that decide which others there are.

    Raises:
        ValueError: Flags of an earlier version, a flag without its value, or an empty
            value.
    """
    parser = argparse.ArgumentParser(
        add_help=False, allow_abbrev=False, exit_on_error=False
    )
    for name in names:
        parser.add_argument(f"--{name}")
    parser.add_argument("--env_options", "--env-options", nargs="*")
    try:
        found = vars(parser.parse_known_args(arguments(args))[0])
    except argparse.ArgumentError as error:
        raise ConfigError(str(error)) from error
    options = found.pop("env_options")
    if options is not None:
        flags = [f"--{option.replace('=', ' ')}" for option in options]
        raise ConfigError(
            "--env_options is gone: options of the task are flags of their own; write "
            + (" ".join(flags) or "--obstacles 2")
        )
    return found


def from_record(record: Mapping[str, Any]) -> TrainConfig[Options]:
    """A configuration from its JSON record; missing fields take defaults.

    No module is imported because a record names it (`envs.outside`). Records of version
    0.1 were flat: their values are parsed as flags.

    Raises:
        ConfigError: It has unknown fields, or values that cannot be run.
    """
    try:
        if "ppo" in record:
            return config_of(record, registry.recorded)
        outside.check_recorded(record["env"])
        return train_flags(record["env"], _flags(record), quiet=True).config
    except SystemExit as error:
        raise ConfigError("no configuration of this version, nor of 0.1") from error
    except ConfigError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"no configuration: {error}") from error


def _flags(record: Mapping[str, Any]) -> list[str]:
    """The flags that say what a record of version 0.1 says."""
    place = ("env", "env_options", "run_dir", "resume", "overwrite", "allow_changes")
    pairs = {name: value for name, value in record.items() if name not in place}
    pairs |= dict(option.split("=") for option in record["env_options"])
    flags = []
    for name, value in pairs.items():
        if str(value).lower() in ("true", "false"):
            flags.append(
                f"--{name}" if str(value).lower() == "true" else f"--no_{name}"
            )
        elif value is not None:
            values = value if isinstance(value, list) else [value]
            flags += [f"--{name}", *map(str, values)]
    return flags


def load_config(path: Path) -> TrainConfig[Options]:
    """The configuration that a run was started with, or a policy trained with.

    Args:
        path: Run folder or policy file.

    Raises:
        ConfigError: It is neither, or its configuration cannot be read.
    """
    if is_policy(path):
        record = load_policy(path).about.get("config", {})
    else:
        path = path / CONFIG
        record = read_record(path)
    try:
        return from_record(record)
    except ConfigError as error:
        raise ConfigError(f"{path} cannot be read as a configuration: {error}") from (
            error
        )
