"""A policy as one file: `export.py`, and `rmp-mjx-export` where this is installed.

NAME.rmp holds policy and controller for a robot (`rmp_mjx.deploy`), NAME.safetensors
the policy alone. A run that finishes writes the latter of its last policy itself.
"""

import dataclasses
import importlib.util
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from rmp_mjx import runtime
from rmp_mjx.deploy.artefact import SUFFIX as ROBOT
from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.policy import load_policy, save_policy
from rmp_mjx.training.runs import identity, policies, run_folder
from rmp_mjx.training.runs.checkpoint import NEWEST, CheckpointError

from . import deployment, registry
from .base import ArmEnv
from .flags import load_config, parse
from .options import CTRL_DT

MOST_SPHERES = 64
"""A robot's loop has no time for more."""


@dataclass(frozen=True)
class ExportOptions:
    """Write a policy with its controller for a robot, or a policy alone."""

    run: Annotated[str, tyro.conf.Positional]
    """Run folder, or policy file; NAME may stand for NAME.safetensors."""
    out: Path
    """File to write, which must not exist yet: NAME.rmp for a robot, or
    NAME.safetensors for the policy alone."""
    robot: str | None = None
    """Arm that the file is for; default: the run's. For NAME.rmp."""
    period: float = 0.001
    """Time between two calls of the controller on the robot [s]. For NAME.rmp."""
    spheres: int = 4
    """Slots for spheres that the robot is told of. For NAME.rmp."""
    guard_speed: float | None = None
    """Put `StopGuard` behind the controller, for obstacles of at most this speed [m/s];
    default: as the run has it. For NAME.rmp."""
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
    file, k = options.out, options.seed_index
    if file.suffix not in (policies.SUFFIX, ROBOT):
        raise ConfigError(
            f"{file}: name it NAME{ROBOT} for a robot, or NAME{policies.SUFFIX} for "
            "the policy alone"
        )
    if file.exists():
        raise ConfigError(f"{file} exists already: delete it, or name another file")
    if not file.parent.is_dir():
        raise ConfigError(f"{file}: there is no folder {file.parent}")
    if options.env:
        registry.task(options.env)
    run = policies.find(options.run)
    config = load_config(run)
    if not 0 <= k < config.ppo.num_seeds:
        raise ConfigError(f"seed_index must lie in 0 .. {config.ppo.num_seeds - 1}")
    if not run.is_dir() and options.checkpoint != NEWEST:
        raise ConfigError(f"{run} is one policy: leave checkpoint out")
    task, besides = config.task, ()
    if file.suffix == ROBOT:
        _check(options)
        if not issubclass(registry.task(task.env), ArmEnv):
            raise ConfigError(f"task '{task.env}' has no arm that a robot could be")
    elif options.robot or options.guard_speed is not None:
        raise ConfigError("a policy alone has no arm: leave robot and guard_speed out")
    if options.robot and options.robot != task.robot:
        task, besides = dataclasses.replace(task, robot=options.robot), (identity.ARM,)
    if (speed := options.guard_speed) is not None:
        task = dataclasses.replace(task, guard=True, obstacle_speed=speed)
    env = registry.make(task)
    iterations, agent = policies.load_agent(
        env, config, run, True, note, k, options.checkpoint, besides
    )
    if run.is_dir():
        own = run_folder.seed_folders(config, run)[k]
        newest = file.suffix == ROBOT and options.checkpoint == NEWEST
        figures = policies.evaluation(own) if newest else None
        about = policies.describe(config, k, run, iterations, figures)
    else:
        about = load_policy(run).about
    if file.suffix == ROBOT:
        period, spheres = options.period, options.spheres
        deployment.export(file, env, agent, about, period, spheres)
    else:
        save_policy(file, agent, about)


def _check(options: ExportOptions) -> None:
    """Refuse a loop that no robot has.

    Raises:
        ConfigError: A value is none.
    """
    if not 1e-4 <= options.period <= CTRL_DT:
        raise ConfigError(f"period must be in [0.0001, {CTRL_DT}] s")
    if not 0 <= options.spheres <= MOST_SPHERES:
        raise ConfigError(f"spheres must be at most {MOST_SPHERES}, at least 0")
    if options.guard_speed is not None and not 0.0 <= options.guard_speed < np.inf:
        raise ConfigError("guard_speed must be finite and at least 0 m/s")
    if importlib.util.find_spec("onnx") is None:
        raise ConfigError("this needs onnx: pip install 'rmp-mjx[deploy]'")


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
    say(f"written: {options.out}, {options.out.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
