"""The training loop: iterations, reports, checkpoints, interruptions."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
from rich.console import Console

from rmp_mjx.training import run_folder
from rmp_mjx.training.checkpoint import Checkpointer
from rmp_mjx.training.config import TrainConfig
from rmp_mjx.training.logging import RunLogger
from rmp_mjx.training.metrics import Row, make_row
from rmp_mjx.training.networks import Agent, make_agent
from rmp_mjx.training.ppo import PPO, TrainState, make_ppo
from rmp_mjx.training.rollout import Env
from rmp_mjx.training.stopping import StopRequest

MAX_LOST_FRACTION = 0.5
"""Training stops where more of an iteration's steps than this become non-finite."""


Note = Callable[[str], None]


class TrainingFailure(RuntimeError):
    """Training cannot go on; the last good checkpoint is kept."""


@dataclass(frozen=True)
class TrainResult:
    """How a call of `train` ended."""

    agent: Agent
    """The policy, as the configuration's evaluation wants it."""
    iterations: int
    """Finished iterations."""
    exit_code: int
    """0, or 128 plus the signal that stopped it."""
    had_finished: bool
    """Whether there was nothing left to do."""


def train(
    env: Env, config: TrainConfig, folder: Path, console: Console | None = None
) -> TrainResult:
    """Train a policy, or continue training one.

    Args:
        env: Single environment.
        config: Validated configuration; `config.resume` continues `folder`.
        folder: Run folder, prepared by `run_folder.open_run`.
        console: Terminal.

    Returns:
        The trained policy and how training ended.

    Raises:
        CheckpointError: The run to continue has no usable checkpoint.
        TrainingFailure: The simulation or the learner became non-finite.
    """
    ppo = make_ppo(env, config)
    gather = jax.jit(ppo.gather, donate_argnums=0)
    learn = jax.jit(ppo.learn, donate_argnums=0)
    checkpoints = Checkpointer(folder / run_folder.CHECKPOINTS, config.checkpoints_kept)
    console = console or Console()
    state, done = _start(ppo, config, checkpoints, console)
    changes = run_folder.describe(folder, config)
    if changes:
        console.print(f"not an exact continuation: {', '.join(changes)}", markup=False)
    logger = RunLogger(
        folder / run_folder.METRICS,
        folder / run_folder.TENSORBOARD,
        config.num_iterations,
        done,
        console,
    )
    first = saved = done
    with StopRequest() as stop, logger:
        while done < config.num_iterations and not stop.signal:
            began = time.monotonic()
            state, data, stats = gather(state)
            state, learning = learn(state, data)
            jax.block_until_ready(state)
            done += 1
            row = make_row(
                done,
                done * config.steps_per_iteration,
                config.steps_per_iteration,
                time.monotonic() - began,
                stats,
                learning,
            )
            last = done == config.num_iterations
            if last or done % config.log_interval == 0:
                logger.add(row)
            _check(row, config, folder)
            if last or stop.signal or done % config.checkpoint_interval == 0:
                checkpoints.save(done, state)
                saved = done
    checkpoints.close()
    if stop.signal:
        console.print(
            f"stopped after iteration {done}, saved {saved}; continue with\n"
            f"  python train.py --resume {folder}",
            markup=False,
            highlight=False,
        )
    agent = make_agent(
        ppo.networks,
        state.normalizer,
        state.learner.policy,
        config.eval_deterministic,
    )
    return TrainResult(
        agent=agent,
        iterations=done,
        exit_code=stop.exit_code,
        had_finished=first >= config.num_iterations,
    )


def _start(
    ppo: PPO, config: TrainConfig, checkpoints: Checkpointer, console: Console
) -> tuple[TrainState, int]:
    """The first state, new or restored, and the iterations behind it."""
    key = jax.random.key(config.seed)
    if not config.resume:
        state = jax.jit(ppo.init)(key)
        return jax.tree.map(jnp.copy, state), 0  # donation wants distinct buffers
    template = jax.eval_shape(ppo.init, key)
    done, state = checkpoints.restore(template, console.print)
    if done >= config.num_iterations:
        console.print(
            f"{config.resume} has finished: {done} iterations; "
            "a larger --num_timesteps continues it"
        )
    return state, done


def _check(row: Row, config: TrainConfig, folder: Path) -> None:
    """Stop before a broken iteration is saved."""
    updates = config.num_updates_per_batch * config.num_minibatches
    lost = int(row["nonfinite_steps"] or 0)
    skipped = int(row["learning/skipped_updates"] or 0)
    if lost > MAX_LOST_FRACTION * config.steps_per_iteration:
        cause = f"{lost} of {config.steps_per_iteration} steps became non-finite"
    elif skipped >= updates:
        cause = f"all {updates} updates had non-finite gradients"
    else:
        return
    raise TrainingFailure(
        f"iteration {row['iteration']}: {cause}; "
        f"the last good checkpoint is in {folder / run_folder.CHECKPOINTS}"
    )


def load_agent(
    env: Env, config: TrainConfig, folder: Path, deterministic: bool, note: Note
) -> tuple[int, Agent]:
    """Read the policy of a run.

    Args:
        env: The environment it was trained on, or one with the same sizes.
        config: Configuration of the run.
        folder: Run folder.
        deterministic: Act with the mean action.
        note: Called with one line for each damaged checkpoint.

    Returns:
        Iterations behind the policy, and the policy.

    Raises:
        CheckpointError: There is no usable checkpoint.
    """
    ppo = make_ppo(env, config)
    whole = jax.eval_shape(ppo.init, jax.random.key(0))
    learner = whole.learner.replace(value=None, policy_opt=None, value_opt=None)
    needed = whole.replace(
        learner=learner, scale=None, rollout=None, key=None, iteration=None
    )
    checkpoints = Checkpointer(folder / run_folder.CHECKPOINTS, read_only=True)
    step, state = checkpoints.restore(needed, note)
    checkpoints.close()
    agent = make_agent(
        ppo.networks, state.normalizer, state.learner.policy, deterministic
    )
    return step, agent
