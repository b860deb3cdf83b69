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
    physics: str | None = None
    """Physics engine; default: the run's, or mujoco."""
    episodes: int = 100
    """Episodes, run in parallel."""
    deterministic: bool = False
    """Act with the policy's mean rather than samples."""
    seed: int = 0
    """Seed of the starts and of sampled actions."""
    video: bool = False
    """Render one episode, where headless rendering is available."""
    out: str | None = None
    """Folder for eval.json and the video; default: the run's folder, or one under
    runs/ named after agent, task and controller."""

    def resolve(self) -> tuple[TrainConfig, Path]:
        """Fill in what the run says.

        Returns:
            The training configuration to load the task and the policy with, and
            the folder for results.

        Raises:
            ConfigError: The options contradict each other, or run is no run folder.
        """
        if self.episodes < 1:
            raise ConfigError(f"episodes must be at least 1, is {self.episodes}")
        if (self.run is None) == (self.agent == "policy"):
            raise ConfigError("give either --run RUN or --agent zero|random")
        base = load_config(Path(self.run) / CONFIG) if self.run else TrainConfig()
        config = dataclasses.replace(
            base,
            resume=None,
            env=self.env or base.env,
            controller=self.controller or base.controller,
            physics=self.physics or base.physics,
        )
        name = f"{self.agent}-{config.env}-{config.controller}"
        out = self.out or self.run or f"runs/{name}"
        return config, Path(out)
