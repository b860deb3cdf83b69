"""Training configuration: small dataclasses, checked when they are made."""

import dataclasses
import math
from typing import Any, Generic, Literal, Protocol, TypeVar

from rmp_mjx.fields import check
from rmp_mjx.names import unknown

SEEDS = 2**32
"""Seeds have 32 bits: JAX would take a larger one for another."""

MOST = 2**30
"""The largest size: JAX counts with 32 bits, and some counts are sums of two."""

MOST_PASSES = 1000
"""Most passes over an iteration's data; PPO makes 3 to 80. An iteration with many more
would seem to hang."""

LOG_STD_LIMIT = 20.0
"""Magnitude of an initial log standard deviation: actions are within [-1, 1]."""


class ConfigError(ValueError):
    """A configuration that cannot be run; the message says what to change."""


class Task(Protocol):
    """What training needs of a task's options; a frozen dataclass."""

    @property
    def title(self) -> str:
        """The task in a few words, for figures and folder names."""
        ...

    def record(self) -> dict[str, Any]:
        """The options by name, JSON-ready: equal records are equal tasks."""
        ...


AnyTask = TypeVar("AnyTask", bound=Task)


def _at_least_one(config: Any, *names: str) -> None:
    for name in names:
        if getattr(config, name) < 1:
            raise ConfigError(f"{name} must be at least 1, is {getattr(config, name)}")


def _at_most(most: int, config: Any, *names: str) -> None:
    for name in names:
        value = getattr(config, name)
        if max(value) > most if isinstance(value, tuple) else value > most:
            raise ConfigError(f"{name} must be at most {most:,}")


def _positive(config: Any, *names: str) -> None:
    for name in names:
        if not getattr(config, name) > 0.0:
            raise ConfigError(f"{name} must be positive, is {getattr(config, name)}")


def _not_negative(config: Any, *names: str) -> None:
    for name in names:
        if not getattr(config, name) >= 0:
            raise ConfigError(f"{name} must not be negative: {getattr(config, name)}")


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """The learning: what defines a run, together with its task."""

    num_envs: int = 256
    """Environments that run in parallel, for each agent."""
    seed: int = 0
    """Seed of the networks, the environments and the minibatch order."""
    num_seeds: int = 1
    """Agents that train in one program, apart, with seeds seed, seed + 1, ..."""
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
    final_log_std: float | None = None
    """Greatest log standard deviation of the actions after `anneal_steps`; the bound
    falls to it over their last third, from `init_log_std`. None: no bound."""
    anneal_steps: int = 1_500_000
    """Policy steps of an agent after which `final_log_std` holds."""
    demos: str | None = None
    """File of demonstrations; the policy starts as a clone of them."""
    reward_scaling: float = 1e-3
    """Factor on the rewards, for trainer brax: ours scales value targets by itself."""

    def __post_init__(self):
        """Check the values.

        Raises:
            ConfigError: Something cannot be run; the message names the option.
        """
        check(self, ConfigError)
        _at_least_one(
            self,
            "num_envs",
            "num_seeds",
            "unroll_length",
            "num_minibatches",
            "num_groups",
            "num_updates_per_batch",
            "anneal_steps",
        )
        _positive(
            self,
            "learning_rate",
            "value_learning_rate",
            "clipping_epsilon",
            "max_grad_norm",
            "reward_scaling",
        )
        _not_negative(self, "entropy_cost", "vf_coefficient", "target_kl", "seed")
        if self.seed + self.num_seeds > SEEDS:
            raise ConfigError(f"seed must have 32 bits, the last is below {SEEDS:,}")
        if not abs(self.init_log_std) <= LOG_STD_LIMIT:
            raise ConfigError(
                f"init_log_std must lie within +-{LOG_STD_LIMIT:g}, is "
                f"{self.init_log_std}"
            )
        for name in ("discounting", "gae_lambda"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ConfigError(
                    f"{name} must lie in [0, 1], is {getattr(self, name)}"
                )
        sizes = "num_envs num_seeds unroll_length num_groups num_minibatches"
        _at_most(MOST, self, *sizes.split())
        _at_most(MOST_PASSES, self, "num_updates_per_batch")
        if not self.hidden_sizes or min(self.hidden_sizes) < 1:
            raise ConfigError(f"hidden_sizes must be positive, is {self.hidden_sizes}")
        _at_most(MOST, self, "hidden_sizes")
        if self.steps_per_iteration % self.num_minibatches:
            raise ConfigError(
                f"num_envs * unroll_length = {self.num_envs} * {self.unroll_length} = "
                f"{self.steps_per_iteration} does not divide into num_minibatches = "
                f"{self.num_minibatches} equal parts"
            )

    @property
    def steps_per_iteration(self) -> int:
        """Policy steps that each agent gathers in one iteration."""
        return self.num_envs * self.unroll_length

    @property
    def groups(self) -> int:
        """Groups of environments: the most, up to `num_groups`, that divide evenly."""
        both = math.gcd(self.num_groups, self.num_envs)
        small = [n for n in range(1, math.isqrt(both) + 1) if both % n == 0]
        return max(
            n
            for n in (*small, *(both // n for n in small))
            if self.num_envs // n * self.unroll_length % self.num_minibatches == 0
        )


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """The run: what may differ between a run and its continuation."""

    num_timesteps: int = 400_000
    """Policy steps of an agent over all its environments, rounded up to whole
    iterations."""
    run_dir: str | None = None
    """Folder of this run; default: runs/TASK-seedSEED-TIME."""
    resume: str | None = None
    """Run folder to continue; its saved configuration is the default then."""
    overwrite: bool = False
    """Delete the results of an earlier run found in run_dir."""
    allow_changes: bool = False
    """Resume although packages or our code have changed; it is no exact continuation
    then."""
    num_devices: int | None = None
    """At most this many devices share the environments; default: all there are."""
    log_interval: int = 1
    """Iterations between rows of the metrics."""
    checkpoint_interval: int = 20
    """Iterations between checkpoints; the last iteration is always saved."""
    checkpoints_kept: int = 3
    """Newest checkpoints that are kept, besides the best by success, then return."""
    keep_every: int = 0
    """Checkpoints at multiples of this many iterations are never deleted; 0: none."""
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

    def __post_init__(self):
        """Check the values.

        Raises:
            ConfigError: Something cannot be run; the message names the option.
        """
        check(self, ConfigError)
        _at_least_one(
            self,
            "num_timesteps",
            "log_interval",
            "checkpoint_interval",
            "checkpoints_kept",
        )
        _not_negative(self, "keep_every", "eval_episodes")
        _at_most(MOST, self, "eval_episodes")
        if self.num_devices is not None:
            _at_least_one(self, "num_devices")
        if self.keep_every % self.checkpoint_interval:
            raise ConfigError(
                f"keep_every = {self.keep_every} is no multiple of "
                f"checkpoint_interval = {self.checkpoint_interval}"
            )
        if self.resume and self.run_dir and self.resume != self.run_dir:
            raise ConfigError("resume continues in its own folder: leave run_dir out")
        if self.resume and self.overwrite:
            raise ConfigError("resume and overwrite exclude each other")


@dataclasses.dataclass(frozen=True)
class TrainConfig(Generic[AnyTask]):
    """The whole configuration: task, learning, run and trainer."""

    task: AnyTask
    """Options of the task."""
    ppo: PPOConfig = PPOConfig()
    """The learning."""
    run: RunConfig = RunConfig()
    """The run."""
    trainer: Literal["ours", "brax"] = "ours"
    """Who trains: ours, or brax (Brax's own PPO). brax cannot resume a run, train
    several seeds in one program or in several processes, or repeat a run exactly on
    another number of devices. It has no value_learning_rate and no num_groups; its
    learning rate follows target_kl."""

    def __post_init__(self):
        """Check what the parts ask for together.

        Raises:
            ConfigError: Something cannot be run; the message names the option.
        """
        check(self, ConfigError)
        if self.trainer == "brax" and self.run.resume:
            raise ConfigError("trainer brax cannot resume a run")
        if self.trainer == "brax" and self.ppo.num_seeds > 1:
            raise ConfigError("trainer brax trains one seed: leave num_seeds out")
        if self.trainer == "brax" and self.ppo.final_log_std is not None:
            raise ConfigError("trainer brax has no final_log_std: leave it out")
        if self.trainer == "brax" and self.ppo.demos is not None:
            raise ConfigError("trainer brax clones no demos: leave them out")
        if self.trainer == "brax" and self.ppo.num_envs % self.ppo.num_minibatches:
            raise ConfigError(
                "trainer brax divides environments into minibatches: num_envs = "
                f"{self.ppo.num_envs} is no multiple of num_minibatches = "
                f"{self.ppo.num_minibatches}"
            )

    @property
    def num_iterations(self) -> int:
        """Iterations that reach `num_timesteps`."""
        return -(-self.run.num_timesteps // self.ppo.steps_per_iteration)

    @property
    def title(self) -> str:
        """The run in a few words."""
        first, last = self.ppo.seed, self.ppo.seed + self.ppo.num_seeds - 1
        seeds = f"seed {first}" if last == first else f"seeds {first} to {last}"
        return f"{self.task.title}, {seeds}"

    def replace(self, **changes: Any) -> "TrainConfig[AnyTask]":
        """A copy with other values; each name finds its part (`seed` is in `ppo`).

        Raises:
            ConfigError: No part has such an option; the message lists the names.
        """
        own: dict[str, Any] = {}
        nested: dict[str, dict[str, Any]] = {"task": {}, "ppo": {}, "run": {}}
        owner = {
            field.name: part
            for part in nested
            for field in dataclasses.fields(getattr(self, part))
        }
        valid = [*owner, *nested, "trainer"]
        for name, value in changes.items():
            if name not in valid:
                raise ConfigError(unknown("option", name, valid))
            (nested[owner[name]] if name in owner else own)[name] = value
        for part, values in nested.items():
            if values:
                before = own.get(part, getattr(self, part))
                own[part] = dataclasses.replace(before, **values)
        return dataclasses.replace(self, **own)

    def record(self) -> dict[str, Any]:
        """The configuration as it is written to JSON."""
        return {
            "task": self.task.record(),
            "ppo": dataclasses.asdict(self.ppo),
            "run": dataclasses.asdict(self.run),
            "trainer": self.trainer,
        }
