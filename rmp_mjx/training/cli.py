"""Command-line parsing for the entry points."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, TypeVar

import tyro

from rmp_mjx.training.config import ConfigError, TrainConfig, load_config
from rmp_mjx.training.run_folder import CONFIG

Options = TypeVar("Options")


def parse(kind: type[Options], args: Sequence[str] | None, default=None) -> Options:
    """Parse options into a dataclass; `--num_envs` and `--num-envs` are the same.

    Exits with code 2 and a message where the options are wrong.
    """
    if default is None:
        return tyro.cli(kind, args=args, use_underscores=True)
    return tyro.cli(kind, args=args, default=default, use_underscores=True)


def parse_train(args: Sequence[str] | None = None) -> TrainConfig:
    """Parse the options of a training run.

    With `--resume RUN` the defaults are those that RUN was started with.

    Raises:
        ConfigError: RUN is no run folder.
    """
    config = parse(TrainConfig, args)
    if not config.resume:
        return config
    saved = load_config(Path(config.resume) / CONFIG)
    default = dataclasses.replace(saved, resume=None, run_dir=None, overwrite=False)
    return parse(TrainConfig, args, default)


REFERENCE = {"mujoco": ("sim_dt=0.002", "cone=elliptic"), "mjx": ()}
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
    physics: Literal["mujoco", "mjx"] | None = None
    """A second physics engine, where the same policy meets the same starts; mujoco: the
    C engine with 2 ms steps and elliptic friction cones."""
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
