"""Training configuration: one flat dataclass, checked before anything compiles."""

import dataclasses
import difflib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rmp_mjx.files import write_text

CONTROLLERS = ("rmp_vices", "vices", "rmp_vices_literal", "osc", "vices_cbf")
PHYSICS = ("auto", "mujoco", "mjx", "warp")


class ConfigError(ValueError):
    """A configuration that cannot be run; the message says what to change."""


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Train a policy with PPO (Schulman et al., 2017)."""

    env: str = "trajectory"
    """Task to learn."""
    controller: str = "rmp_vices"
    """Low-level controller that the policy commands: rmp_vices, vices,
    rmp_vices_literal (the paper's formulas with their signs corrected), osc (vices with
    a fixed impedance), or vices_cbf (vices behind a safety filter)."""
    physics: str = "auto"
    """Physics engine: mujoco (C threads), mjx (JAX), warp (MuJoCo Warp; extra `warp`),
    or auto: mujoco on a CPU, else mjx."""
    env_options: tuple[str, ...] = ()
    """Options of the task as NAME=VALUE, for instance obstacles=2 layout=close."""
    num_envs: int = 256
    """Environments that run in parallel, for each agent."""
    num_timesteps: int = 400_000
    """Policy steps of an agent over all its environments, rounded up to whole
    iterations."""
    seed: int = 0
    """Seed of the networks, the environments and the minibatch order."""
    num_seeds: int = 1
    """Agents that train in one program, apart, with seeds seed, seed + 1, ..."""
    run_dir: str | None = None
    """Folder of this run; default: runs/ENV-CONTROLLER-seedSEED-TIME."""
    resume: str | None = None
    """Run folder to continue; its saved configuration is the default then."""
    overwrite: bool = False
    """Delete the results of an earlier run found in run_dir."""
    allow_changes: bool = False
    """Resume although packages or our code have changed; it is no exact continuation
    then."""

    unroll_length: int = 16
    """Policy steps per environment and iteration."""
    num_minibatches: int = 8
    """Minibatches per pass over an iteration's data."""
    num_groups: int = 8
    """Groups of environments; every minibatch takes as many steps from each. Fewer
    groups where the sizes do not divide. The devices share whole groups."""
    num_updates_per_batch: int = 10
    """Passes over an iteration's data (epochs)."""
    discounting: float = 0.99
    """Discount per policy step."""
    gae_lambda: float = 0.97
    """Lambda of generalised advantage estimation."""
    learning_rate: float = 3e-4
    """Adam step size of the policy."""
    value_learning_rate: float = 1e-3
    """Adam step size of the value function."""
    clipping_epsilon: float = 0.2
    """Clip range of PPO's probability ratio."""
    entropy_cost: float = 0.0
    """Weight of the entropy bonus."""
    vf_coefficient: float = 1.0
    """Weight of the value loss (errors in units of the returns' deviation)."""
    max_grad_norm: float = 1.0
    """Gradients, the policy's and the value's each, are clipped to this norm."""
    target_kl: float = 0.02
    """An iteration's policy updates stop beyond 1.5 times this; 0: never."""
    hidden_sizes: tuple[int, ...] = (64, 64)
    """Hidden layers of the policy and of the value network (tanh)."""
    init_log_std: float = -0.5
    """Initial log standard deviation of the policy's actions."""

    num_devices: int | None = None
    """At most this many devices share the environments; default: all there are."""
    log_interval: int = 1
    """Iterations between rows of the metrics."""
    checkpoint_interval: int = 20
    """Iterations between checkpoints; the last iteration is always saved."""
    checkpoints_kept: int = 3
    """Newest checkpoints that are kept, besides the best by success, then return."""
    keep_every: int = 0
    """Checkpoints at multiples of this many iterations are kept for good; 0: none."""
    eval_episodes: int = 100
    """Episodes of the final evaluation; 0: none, and no pictures."""
    eval_deterministic: bool = True
    """Evaluate the mean action rather than sampled ones."""
    video: bool = True
    """Draw pictures and a video of the evaluation, where headless rendering works."""
    wandb: str | None = None
    """Also log to this project of Weights & Biases (needs the extra `wandb`)."""
    mlflow: str | None = None
    """Also log to this experiment of MLflow (needs the extra `mlflow`)."""

    @property
    def steps_per_iteration(self) -> int:
        """Policy steps that each agent gathers in one iteration."""
        return self.num_envs * self.unroll_length

    @property
    def num_iterations(self) -> int:
        """Iterations that reach `num_timesteps`."""
        return -(-self.num_timesteps // self.steps_per_iteration)

    @property
    def groups(self) -> int:
        """Groups of environments: the most, up to `num_groups`, that divide evenly."""
        return max(
            n
            for n in range(1, self.num_groups + 1)
            if self.num_groups % n == 0
            and self.num_envs % n == 0
            and self.num_envs // n * self.unroll_length % self.num_minibatches == 0
        )


# May differ between a run and its continuation; everything else defines the run.
RESUMABLE = frozenset(
    {
        "num_timesteps",
        "run_dir",
        "resume",
        "overwrite",
        "allow_changes",
        "num_devices",
        "log_interval",
        "checkpoint_interval",
        "checkpoints_kept",
        "keep_every",
        "wandb",
        "mlflow",
        "eval_episodes",
        "eval_deterministic",
        "video",
    }
)
AT_LEAST_ONE = (
    "num_envs",
    "num_seeds",
    "num_timesteps",
    "unroll_length",
    "num_minibatches",
    "num_groups",
    "num_updates_per_batch",
    "log_interval",
    "checkpoint_interval",
    "checkpoints_kept",
)
POSITIVE = (
    "learning_rate",
    "value_learning_rate",
    "clipping_epsilon",
    "max_grad_norm",
)
NOT_NEGATIVE = (
    "entropy_cost",
    "vf_coefficient",
    "target_kl",
    "keep_every",
    "eval_episodes",
    "seed",
)


def _known(value: str, what: str, names: Sequence[str]) -> None:
    if value in names:
        return
    near = difflib.get_close_matches(value, names, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    raise ConfigError(f"unknown {what} {value!r}; known: {', '.join(names)}.{hint}")


def validate(config: TrainConfig, known_envs: Iterable[str]) -> TrainConfig:
    """Check a configuration; compiles nothing.

    Args:
        config: The configuration.
        known_envs: Names that the environment loader accepts.

    Returns:
        The same configuration.

    Raises:
        ConfigError: Something cannot be run; the message names the option.
    """
    _known(config.env, "env", sorted(known_envs))
    _known(config.controller, "controller", CONTROLLERS)
    _known(config.physics, "physics", PHYSICS)
    for text in config.env_options:
        name = text.partition("=")[0]
        if name in ("controller", "physics"):
            raise ConfigError(f"{name} is an option of its own: --{name}")
    for name in AT_LEAST_ONE:
        if getattr(config, name) < 1:
            raise ConfigError(f"{name} must be at least 1, is {getattr(config, name)}")
    for name in POSITIVE:
        if not getattr(config, name) > 0.0:
            raise ConfigError(f"{name} must be positive, is {getattr(config, name)}")
    for name in NOT_NEGATIVE:
        if not getattr(config, name) >= 0:
            raise ConfigError(f"{name} must not be negative: {getattr(config, name)}")
    for name in ("discounting", "gae_lambda"):
        if not 0.0 <= getattr(config, name) <= 1.0:
            raise ConfigError(f"{name} must lie in [0, 1], is {getattr(config, name)}")
    if not config.hidden_sizes or min(config.hidden_sizes) < 1:
        raise ConfigError(f"hidden_sizes must be positive, is {config.hidden_sizes}")
    if config.steps_per_iteration % config.num_minibatches:
        raise ConfigError(
            f"num_envs * unroll_length = {config.num_envs} * {config.unroll_length} = "
            f"{config.steps_per_iteration} does not divide into num_minibatches = "
            f"{config.num_minibatches} equal parts"
        )
    if config.num_devices is not None and config.num_devices < 1:
        raise ConfigError(f"num_devices must be at least 1, is {config.num_devices}")
    if config.keep_every % config.checkpoint_interval:
        raise ConfigError(
            f"keep_every = {config.keep_every} is no multiple of checkpoint_interval = "
            f"{config.checkpoint_interval}"
        )
    if config.resume and config.run_dir and config.resume != config.run_dir:
        raise ConfigError("resume continues in its own folder: leave run_dir out")
    if config.resume and config.overwrite:
        raise ConfigError("resume and overwrite exclude each other")
    return config


def differing_fields(old: TrainConfig, new: TrainConfig) -> dict[str, tuple]:
    """Fields that define a run and differ between two configurations."""
    return {
        field.name: (getattr(old, field.name), getattr(new, field.name))
        for field in dataclasses.fields(TrainConfig)
        if field.name not in RESUMABLE
        and getattr(old, field.name) != getattr(new, field.name)
    }


def save_config(config: TrainConfig, path: Path) -> None:
    """Write a configuration as JSON."""
    write_text(path, json.dumps(dataclasses.asdict(config), indent=2) + "\n")


def config_of(saved: dict[str, Any]) -> TrainConfig:
    """A configuration from the values that JSON gives back."""
    values: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in saved.items()
    }
    return TrainConfig(**values)


def load_config(path: Path) -> TrainConfig:
    """Read a configuration written by `save_config`; missing fields take defaults.

    Raises:
        ConfigError: The file is missing, is not JSON, or has unknown fields.
    """
    try:
        return config_of(json.loads(path.read_text()))
    except FileNotFoundError as error:
        raise ConfigError(f"{path.parent} is no run folder: no {path.name}") from error
    except (json.JSONDecodeError, AttributeError, TypeError) as error:
        raise ConfigError(f"{path} cannot be read as a configuration: {error}") from (
            error
        )
