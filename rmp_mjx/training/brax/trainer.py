"""Brax's trainer, with the run folder, reports and interruptions of our own loop."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from brax.training.agents.ppo import train as brax_ppo
from rich.console import Console

from rmp_mjx.training.brax.environment import Batch
from rmp_mjx.training.brax.replicated import device_put_replicated
from rmp_mjx.training.config import ConfigError, TrainConfig
from rmp_mjx.training.learning.learner import Learner, TrainState
from rmp_mjx.training.learning.networks import make_agent, make_networks
from rmp_mjx.training.learning.ppo import MIN_OBS_STD
from rmp_mjx.training.learning.rollout import Env, RolloutStats
from rmp_mjx.training.runs import identity, run_folder
from rmp_mjx.training.runs.checkpoint import Checkpointer
from rmp_mjx.training.runs.logging import RunLogger
from rmp_mjx.training.runs.loop import TrainResult
from rmp_mjx.training.runs.metrics import make_row
from rmp_mjx.training.runs.saving import Commands, Saver, StopRequest, TrainingFailure
from rmp_mjx.training.runs.trackers import open_trackers
from rmp_mjx.training.runs.watch import Watch

LEARNING = {
    "policy_loss": "training/policy_loss",
    "value_loss": "training/v_loss",
    "kl": "training/kl_mean",
    "action_std": "training/policy_dist_mean_std",
}
"""Our names of the learner's metrics, and Brax's."""


class _Stopped(Exception):
    """Leaves Brax's trainer after an iteration."""


class _Iterations:
    """What happens between Brax's training steps: rows, checkpoints, a stop."""

    def __init__(
        self,
        config: TrainConfig,
        logger: RunLogger,
        saver: Saver,
        watch: Watch,
        stop: StopRequest,
    ):
        """Nothing is done yet; the parts are those of our own loop."""
        self.done = 0
        self.params: Any = None
        self._config = config
        self._logger = logger
        self._saver = saver
        self._watch = watch
        self._stop = stop
        self._reports: list[RolloutStats] = []
        self._began = time.monotonic()

    def report(self, stats: RolloutStats) -> None:
        """Take a device's statistics."""
        self._reports.append(stats)

    def keep(self, steps: int, make_policy: Any, params: Any) -> None:
        """Take the parameters; Brax calls this after each step, before `finish`."""
        del make_policy
        self.params = params
        if not steps:
            self._began = time.monotonic()

    def finish(self, steps: int, metrics: Mapping[str, Any]) -> None:
        """Report an iteration and save it where it is time."""
        jax.effects_barrier()  # the statistics have arrived
        seconds = time.monotonic() - self._began
        config, size = self._config, self._config.ppo.steps_per_iteration
        stats = jax.tree.map(lambda *parts: np.sum(parts), *self._reports)
        learning = {ours: metrics[theirs] for ours, theirs in LEARNING.items()}
        self.done = steps // size
        row = make_row(self.done, steps, size, seconds, stats, learning)
        self._reports.clear()
        last = self.done == config.num_iterations
        if last or self.done % config.run.log_interval == 0:
            self._logger.add(row)
        self._saver.count([row])
        self._watch.report([row], None)
        broken = self._watch.abort_reason([row])
        if not np.isfinite([float(x) for x in learning.values()]).all():
            broken = f"iteration {self.done}: the losses became non-finite"
        final = bool(last or self._stop.signal or broken)
        if final or self.done % config.run.checkpoint_interval == 0:
            self._logger.flush()
            if not broken:
                self._saver.save(self.done, _policy_state(self.params), final)
        if broken:
            raise TrainingFailure(f"{broken}; {self._saver.how_to_continue()}")
        if self._stop.signal and not last:
            raise _Stopped
        self._began = time.monotonic()


def train(
    env: Env, config: TrainConfig, folder: Path, console: Console | None = None
) -> TrainResult:
    """Train a policy by `brax.training.agents.ppo.train`.

    The policy is the same network as `runs.loop.train`'s, the run folder has the same
    files with the same columns, but its checkpoints hold the policy alone.

    Args:
        env: Single environment.
        config: Configuration.
        folder: Run folder, prepared by `run_folder.open_run`.
        console: Terminal.

    Returns:
        The trained policy and how training ended.

    Raises:
        ConfigError: Several processes train together.
        TrainingFailure: The simulation or the learner became non-finite, or nothing
            can be saved.
    """
    if jax.process_count() > 1:
        raise ConfigError("trainer brax trains in one process: use --trainer ours")
    console = console or Console()
    given = arguments(env, config)
    kept, place = config.run.checkpoints_kept, folder / run_folder.CHECKPOINTS
    run_id = identity.new_run()
    run_folder.describe(folder, config, env, run_id)
    checkpoints = Checkpointer(place, kept, config.run.keep_every, run_id=run_id)
    used = run_folder.device(given["max_devices_per_host"])
    console.print(f"training with Brax's PPO on {used}", highlight=False)
    console.print(
        f"reward_scaling is {config.ppo.reward_scaling:g}; "
        f"Brax has no {', '.join(NOT_IN_BRAX)}: not used",
        highlight=False,
    )
    logger = RunLogger(
        folder / run_folder.METRICS,
        env.metrics,
        config.num_iterations,
        0,
        console,
        open_trackers(config, folder, folder / run_folder.TENSORBOARD, None),
    )
    nothing = Commands()  # Brax's trainer neither resumes nor keeps faults
    saver = Saver(checkpoints, folder, logger.note, 0, nothing)
    watch = Watch(config, env.metrics, folder, logger.note, nothing)
    with StopRequest() as stop, logger:
        iterations = _Iterations(config, logger, saver, watch, stop)
        batch = Batch(env, config.ppo.unroll_length, iterations.report)
        try:
            with device_put_replicated():
                brax_ppo.train(
                    environment=batch,
                    progress_fn=iterations.finish,
                    policy_params_fn=iterations.keep,
                    **given,
                )
        except _Stopped:
            console.print(
                f"stopped after iteration {iterations.done}; {saver.how_to_continue()}",
                markup=False,
                highlight=False,
            )
    checkpoints.close()
    normalizer, policy, _ = jax.device_get(iterations.params)
    networks = given["network_factory"]()
    return TrainResult(
        agent=make_agent(networks, normalizer, policy, config.run.eval_deterministic),
        iterations=iterations.done,
        exit_code=stop.exit_code,
        had_finished=False,
    )


def _policy_state(params: Any) -> TrainState:
    """The part of a training state that a policy needs (see `policies.load_agent`)."""
    normalizer, policy, _ = params
    nothing: Any = None
    return TrainState(
        learner=Learner(
            policy=policy, value=nothing, policy_opt=nothing, value_opt=nothing
        ),
        normalizer=normalizer,
        scale=nothing,
        rollout=nothing,
        key=nothing,
        iteration=nothing,
    )


NOT_IN_BRAX = ("value_learning_rate", "num_groups")
"""Hyper-parameters of ours that Brax has nothing for."""


def devices(config: TrainConfig) -> int:
    """The largest number of devices that share the environments equally."""
    rows = config.ppo.num_envs // config.ppo.num_minibatches
    most = min(jax.local_device_count(), config.run.num_devices or rows)
    return max(n for n in range(1, most + 1) if rows % n == 0)


def arguments(env: Env, config: TrainConfig) -> dict[str, Any]:
    """Keyword arguments of Brax's trainer, but for environment and callbacks.

    One of Brax's training steps is one iteration of ours: `num_envs` unrolls, and as
    many passes and minibatches over them. Brax calls back between its `num_evals`
    epochs; they are cut to one training step each, and its own evaluations are off.
    Networks, the bounds of normalised observations and the first deviation are ours.
    `target_kl` becomes Brax's `desired_kl`: where our updates stop, its learning rate,
    which is `learning_rate` at first, falls and rises to stay near it.

    Args:
        env: Single environment.
        config: Configuration.

    Returns:
        The arguments.
    """
    ppo = config.ppo
    networks = make_networks(
        env.observation_size, env.action_size, ppo.hidden_sizes, ppo.init_log_std
    )
    return {
        "num_timesteps": config.num_iterations * ppo.steps_per_iteration,
        "num_evals": config.num_iterations + 1,
        "run_evals": False,
        "num_eval_envs": 1,
        "wrap_env": False,
        "episode_length": env.episode_length,
        "max_devices_per_host": devices(config),
        "seed": ppo.seed,
        "num_envs": ppo.num_envs,
        "unroll_length": ppo.unroll_length,
        "num_minibatches": ppo.num_minibatches,
        "batch_size": ppo.num_envs // ppo.num_minibatches,
        "num_updates_per_batch": ppo.num_updates_per_batch,
        "discounting": ppo.discounting,
        "gae_lambda": ppo.gae_lambda,
        "learning_rate": ppo.learning_rate,
        "clipping_epsilon": ppo.clipping_epsilon,
        "entropy_cost": ppo.entropy_cost,
        "vf_loss_coefficient": ppo.vf_coefficient,
        "max_grad_norm": ppo.max_grad_norm,
        "learning_rate_schedule": "ADAPTIVE_KL" if ppo.target_kl else "NONE",
        "desired_kl": ppo.target_kl,
        "reward_scaling": ppo.reward_scaling,
        "normalize_observations": True,
        "normalize_observations_std_eps": MIN_OBS_STD**2,
        "network_factory": lambda *sizes, **preprocessing: networks,
    }
