"""The command lines of `train.py` and `eval.py`."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Generic, Literal

import tyro

from rmp_mjx.fields import check
from rmp_mjx.training.config import (
    MOST,
    SEEDS,
    ConfigError,
    PPOConfig,
    RunConfig,
    TrainConfig,
)
from rmp_mjx.training.runs import policies, run_folder
from rmp_mjx.training.runs.checkpoint import NEWEST

from . import registry
from .flags import (
    DEFAULT,
    EnvName,
    Processes,
    Task,
    TrainOptions,
    from_record,
    load_config,
    named,
    parse,
    train_flags,
)
from .grid import GRID, Grid, load_grid, open_grid
from .options import Options


def make_config(env: str = DEFAULT, **options: Any) -> TrainConfig:
    """A training configuration from flat names, each of its task, learning or run.

    Args:
        env: Name of the task.
        **options: For instance `controller`, `obstacles`, `num_envs`, `run_dir`.

    Raises:
        ValueError: Unknown task, option or value; the message lists the valid ones.
    """
    return TrainConfig(registry.make_options(env)).replace(**options)


def parse_train(args: Sequence[str] | None = None) -> tuple[TrainOptions, Grid | None]:
    """Parse the options of a training run or of a grid.

    With `--resume RUN` the defaults are those that RUN was started with. A task that is
    a `module:Class` must be named besides.

    Returns:
        The options, and the grid if there is one.

    Raises:
        ValueError: RUN is no run folder, or a name or value is none.
    """
    given = named(args, "env", "envs", "controllers", "resume")
    saved: dict[str, TrainConfig] = {}
    controllers, tasks = given["controllers"], given["envs"]
    for name in (tasks or given["env"] or DEFAULT).split(","):
        _admit(name)
    if given["resume"]:
        folder = Path(given["resume"])
        if (folder / GRID).is_file():
            records, those = load_grid(folder)
            saved = {name: from_record(each) for name, each in records.items()}
            if any(name != config.task.env for name, config in saved.items()):
                raise ConfigError(f"{folder / GRID} names a task by another's name")
            controllers = controllers or ",".join(those)
            tasks = tasks or ",".join(saved)
        elif tasks or controllers:
            raise ConfigError(f"{folder} is no grid: leave envs and controllers out")
        else:
            config = load_config(folder)
            saved = {config.task.env: config}
    names = (tasks or given["env"] or next(iter(saved), DEFAULT)).split(",")
    found = [train_flags(name, args, saved.get(name)) for name in names]
    if not tasks and not controllers:
        return found[0], None
    configs = {name: options.config for name, options in zip(names, found, strict=True)}
    chosen = tuple((controllers or found[0].task.controller).split(","))
    return found[0], open_grid(configs, chosen)


REFERENCE = {"mujoco": {"sim_dt": 0.002, "cone": "elliptic"}, "mjx": {}, "warp": {}}
"""Second physics engines, and the task's options that go with them."""


@dataclasses.dataclass(frozen=True)
class EvalOptions(Generic[Task]):
    """Evaluate the policy of a run, or a trivial agent for comparison."""

    task: Task
    """Options of the task; default: the run's."""
    run: str | None = None
    """Run folder whose newest policy is evaluated, or a policy file; NAME may stand for
    NAME.safetensors."""
    agent: Literal["policy", "zero", "random"] = "policy"
    """policy (needs run), or zero or random actions."""
    env: EnvName = DEFAULT
    """Task; default: the run's. Its own options are below."""
    physics: Literal["mujoco", "mjx", "warp"] | None = None
    """A second physics engine, where the same policy meets the same starts; mujoco: the
    C engine with 2 ms steps and elliptic friction cones."""
    checkpoint: str = NEWEST
    """Which checkpoint of the run: newest, best (by the success, then the return, of
    training's episodes), or an iteration's number."""
    seed_index: int = 0
    """Which agent of a run that trained several seeds, from 0."""
    episodes: int = 100
    """Episodes, run in parallel."""
    deterministic: bool = False
    """Act with the policy's mean rather than samples."""
    seed: int = 0
    """Seed of the starts and of sampled actions."""
    video: bool = True
    """Draw pictures and a video, where headless rendering is available."""
    out: str | None = None
    """Folder for the results; default: the run's folder, or one under runs/ named
    after the policy file, or after agent, task and controller."""

    def __post_init__(self):
        """Check the values.

        Raises:
            ConfigError: Nothing is evaluated so.
        """
        check(self, ConfigError)
        if not 1 <= self.episodes <= MOST:
            raise ConfigError(
                f"episodes must be at least 1 and at most {MOST:,}, is {self.episodes}"
            )
        if not 0 <= self.seed < SEEDS:
            raise ConfigError(f"seed must have 32 bits, below {SEEDS:,}")

    @property
    def tasks(self) -> list[Options]:
        """The task, then the one of the second engine if there is one."""
        tasks: list[Options] = [self.task]
        if self.physics:
            other = REFERENCE[self.physics] | {"physics": self.physics}
            tasks.append(dataclasses.replace(self.task, **other))
        return tasks

    @property
    def folder(self) -> Path:
        """Folder for the results."""
        if self.out:
            return Path(self.out)
        if self.run:
            return policies.results_of(Path(self.run))
        name = f"{self.agent}-{self.task.title.replace(', ', '-')}"
        return Path("runs") / run_folder.name_of(name)


def parse_eval(
    args: Sequence[str] | None = None,
) -> tuple[EvalOptions, TrainConfig | None]:
    """Parse the options of an evaluation.

    Returns:
        The options, and what the run was trained with, if there is one.

    Raises:
        ValueError: The options contradict each other, a name or value is none, or run
            is no run folder.
    """
    given = named(args, "env", "run")
    _admit(given["env"] or DEFAULT)
    path = policies.find(given["run"]) if given["run"] else None
    config = load_config(path) if path else None
    env = given["env"] or (config.task.env if config else DEFAULT)
    task = registry.make_options(env)
    if config and config.task.env == env:
        task = config.task
    elif config:
        task = dataclasses.replace(task, controller=config.task.controller)
    # `--physics` is the second engine here, so the task's own is no flag.
    shown = _without_physics(type(task))
    default = EvalOptions(shown(**vars(task)), env=env)
    options = parse(EvalOptions[shown], args, default, env)
    options = dataclasses.replace(
        options,
        task=type(task)(**vars(options.task)),
        run=str(path) if path else options.run,
    )
    if (options.run is None) == (options.agent == "policy"):
        raise ConfigError("give either --run RUN or --agent zero|random")
    if path and not path.is_dir() and options.checkpoint != NEWEST:
        raise ConfigError(f"{path} is one policy: leave checkpoint out")
    seeds = config.ppo.num_seeds if config else 1
    if not 0 <= options.seed_index < seeds:
        raise ConfigError(
            f"seed_index must lie in 0 .. {seeds - 1}, the agents of the run; is "
            f"{options.seed_index}"
        )
    return options, config


def _admit(name: str) -> None:
    """Import a task that the user names; files may name it from then on.

    Raises:
        ValueError: There is none, or it has an option that is a flag already.
    """
    kind = registry.task(name).Options
    parts = (TrainOptions, PPOConfig, RunConfig, Processes, EvalOptions)
    taken = {field.name for part in parts for field in dataclasses.fields(part)}
    shared = {field.name for field in dataclasses.fields(Options)}
    both = [f.name for f in dataclasses.fields(kind) if f.name in taken - shared]
    if both:
        raise ConfigError(
            f"{kind.__name__}: {', '.join(both)}: training or evaluation has an option "
            "of this name; give yours another one"
        )


def _without_physics(kind: type[Options]) -> type[Options]:
    """The options of a task, the physics engine being no flag."""
    hidden = ("physics", tyro.conf.Suppress[str], dataclasses.field(default="auto"))
    same = {"__doc__": kind.__doc__, "__module__": kind.__module__}
    return dataclasses.make_dataclass(
        kind.__name__, [hidden], bases=(kind,), frozen=True, namespace=same
    )
