"""Command-line parsing for the entry points."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import tyro

from envs.grid import GRID, Grid, load_grid, open_grid
from rmp_mjx.training.config import ConfigError, TrainConfig, load_config
from rmp_mjx.training.runs.checkpoint import NEWEST
from rmp_mjx.training.runs.run_folder import CONFIG

Options = TypeVar("Options")


def parse(kind: type[Options], args: Sequence[str] | None, default=None) -> Options:
    """Parse options into a dataclass; `--num_envs` and `--num-envs` are the same.

    Exits with code 2 and a message where the options are wrong.
    """
    if default is None:
        return tyro.cli(kind, args=args, use_underscores=True)
    return tyro.cli(kind, args=args, default=default, use_underscores=True)


@dataclasses.dataclass(frozen=True)
class TrainOptions(TrainConfig):
    """Train a policy with PPO (Schulman et al., 2017), or a grid of policies."""

    envs: str | None = None
    """Tasks of a grid, joined by commas: one run for each of them and each of
    `controllers`, one after the other."""
    controllers: str | None = None
    """Controllers of a grid, joined by commas."""
    coordinator: str | None = None
    """HOST:PORT of process 0, where several processes train together; under Slurm's
    srun this and the next two are found out."""
    process_id: int | None = None
    """Number of this process, from 0."""
    num_processes: int | None = None
    """Number of processes."""

    @property
    def config(self) -> TrainConfig:
        """The options of a run."""
        fields = dataclasses.fields(TrainConfig)
        return TrainConfig(**{f.name: getattr(self, f.name) for f in fields})

    @property
    def grid(self) -> Grid | None:
        """The grid that is asked for, if one is."""
        if not self.envs and not self.controllers:
            return None
        envs = tuple((self.envs or self.env).split(","))
        controllers = tuple((self.controllers or self.controller).split(","))
        return open_grid(self.config, envs, controllers)


def parse_train(args: Sequence[str] | None = None) -> TrainOptions:
    """Parse the options of a training run or of a grid.

    With `--resume RUN` the defaults are those that RUN was started with.

    Raises:
        ConfigError: RUN is no run folder.
    """
    options = parse(TrainOptions, args)
    if not options.resume:
        return options
    folder, saved = Path(options.resume), {}
    if (folder / GRID).exists():
        base, envs, controllers = load_grid(folder)
        saved = {"envs": ",".join(envs), "controllers": ",".join(controllers)}
    else:
        base = load_config(folder / CONFIG)
    default: dict[str, Any] = {**dataclasses.asdict(base), **saved}
    default |= {"resume": None, "run_dir": None}
    default |= {"overwrite": False, "allow_changes": False}
    return parse(TrainOptions, args, TrainOptions(**default))


REFERENCE = {"mujoco": ("sim_dt=0.002", "cone=elliptic"), "mjx": (), "warp": ()}
"""Second physics engines, and the task's options that go with them."""

SHORTHANDS = (
    "obstacles",
    "layout",
    "obstacle_speed",
    "obstacle_noise",
    "obstacle_delay",
    "terminate_on_event",
)
"""Options of `EvalConfig` that are options of the task."""


@dataclasses.dataclass(frozen=True)
class EvalConfig:
    """Evaluate the policy of a run, or a trivial agent for comparison."""

    run: str | None = None
    """Run folder whose newest policy is evaluated."""
    agent: Literal["policy", "zero", "random"] = "policy"
    """policy (needs run), or zero or random actions."""
    env: str | None = None
    """Task; default: the run's, or trajectory."""
    controller: str | None = None
    """Low-level controller; default: the run's, or rmp_vices."""
    obstacles: int | None = None
    """Random spheres in every episode; this and the next five: default the run's."""
    layout: str | None = None
    """How near the spheres may be at the start: far or close."""
    obstacle_speed: float | None = None
    """Speed of the spheres [m/s]."""
    obstacle_noise: float | None = None
    """Standard deviation of their measured positions [m]."""
    obstacle_delay: float | None = None
    """Age of their measured positions [s]."""
    terminate_on_event: bool | None = None
    """Whether a collision or joint-limit event ends the episode."""
    env_options: tuple[str, ...] = ()
    """Further options of the task as NAME=VALUE; they add to the run's."""
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
    after agent, task and controller."""

    def resolve(self) -> tuple[list[TrainConfig], Path]:
        """Fill in what the run says.

        Returns:
            The configuration to load the task and the policy with, then, where one
            is asked for, that of the second physics engine; and the folder for
            results.

        Raises:
            ConfigError: The options contradict each other, or run is no run folder.
        """
        if self.episodes < 1:
            raise ConfigError(f"episodes must be at least 1, is {self.episodes}")
        if (self.run is None) == (self.agent == "policy"):
            raise ConfigError("give either --run RUN or --agent zero|random")
        base = load_config(Path(self.run) / CONFIG) if self.run else TrainConfig()
        if not 0 <= self.seed_index < base.num_seeds:
            raise ConfigError(
                f"seed_index must lie in 0 .. {base.num_seeds - 1}, the agents of the "
                f"run; is {self.seed_index}"
            )
        asked = [(name, getattr(self, name)) for name in SHORTHANDS]
        given = tuple(f"{name}={value}" for name, value in asked if value is not None)
        config = dataclasses.replace(
            base,
            resume=None,
            env=self.env or base.env,
            controller=self.controller or base.controller,
            env_options=base.env_options + self.env_options + given,
        )
        configs = [config]
        if self.physics:
            options = config.env_options + REFERENCE[self.physics]
            configs.append(
                dataclasses.replace(config, physics=self.physics, env_options=options)
            )
        name = f"{self.agent}-{config.env}-{config.controller}"
        out = self.out or self.run or f"runs/{name}"
        return configs, Path(out)
