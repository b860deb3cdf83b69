"""The training loop: iterations, reports, checkpoints, interruptions."""

import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import jax
from rich.console import Console

from rmp_mjx.training.runs import distributed, run_folder
from rmp_mjx.training.learning import seeds
from rmp_mjx.training.runs.checkpoint import NEWEST, Checkpointer
from rmp_mjx.training.config import TrainConfig
from rmp_mjx.training.runs.logging import RunLogger
from rmp_mjx.training.runs.metrics import make_rows
from rmp_mjx.training.learning.networks import Agent, make_agent
from rmp_mjx.training.learning.ppo import make_ppo
from rmp_mjx.training.learning.state import TrainState
from rmp_mjx.training.learning.rollout import Env
from rmp_mjx.training.runs.saving import Saver
from rmp_mjx.training.runs.stopping import StopRequest, TrainingFailure
from rmp_mjx.training.runs.trackers import open_trackers
from rmp_mjx.training.runs.watch import Watch, is_finite

Note = Callable[[str], None]


@dataclass(frozen=True)
class TrainResult:
    """How a call of `train` ended."""

    agent: Agent
    """The policy in the form that evaluation needs; stacked if there are several seeds
    (`seeds.of_seed`)."""
    iterations: int
    """Finished iterations."""
    exit_code: int
    """0, or 128 plus the signal that stopped it."""
    had_finished: bool
    """Whether the run had finished before."""


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
        TrainingFailure: The simulation or the learner became non-finite, or nothing
            can be saved.
    """
    programs = seeds.programs(env, config)
    mesh = programs.mesh
    primary = distributed.is_primary()
    console = console or Console()
    checkpoints = None
    if primary or config.resume:
        kept = config.checkpoints_kept
        place = folder / run_folder.CHECKPOINTS
        checkpoints = Checkpointer(place, kept, config.keep_every, not primary)
    state, done = _start(programs, config, checkpoints, console)
    changes = run_folder.describe(folder, config) if primary else []
    console.print(f"training on {run_folder.device(mesh.size)}", highlight=False)
    if changes:
        console.print(f"not an exact continuation: {', '.join(changes)}", markup=False)
    logger = None
    if primary:
        logger = RunLogger(
            folder / run_folder.METRICS,
            config.num_iterations,
            done,
            console,
            open_trackers(
                config,
                folder,
                folder / run_folder.TENSORBOARD,
                done * config.steps_per_iteration if config.resume else None,
            ),
        )
    note = logger.note if logger else console.print
    saver = Saver(checkpoints if primary else None, folder, note, done)
    watch = Watch(config, folder, note)
    first = done
    stopping = 0
    with StopRequest() as stop, logger or nullcontext():
        while done < config.num_iterations and not stopping:
            began = time.monotonic()
            state, data, stats = programs.gather(state)
            state, learning = programs.learn(state, data)
            jax.block_until_ready(state)
            done += 1
            seconds = time.monotonic() - began
            rows = make_rows(config, done, seconds, stats, learning)
            last = done == config.num_iterations
            if logger and (last or done % config.log_interval == 0):
                logger.add(*rows)
            saver.count(rows)
            fault = None
            if any(row["nonfinite_envs"] for row in rows):
                fault = distributed.collected(state.rollout.fault, mesh)
            if primary:
                watch.report(rows, fault)
            broken = watch.abort_reason(rows)
            stopping = distributed.largest(stop.signal or 0)
            final = bool(last or stopping or broken)
            if final or done % config.checkpoint_interval == 0:
                if logger:
                    logger.flush()
                if not broken or is_finite(state):
                    saver.save(done, distributed.collected(state, mesh), final)
            if broken:
                raise TrainingFailure(f"{broken}; {saver.how_to_continue()}")
    if checkpoints:
        checkpoints.close()
    if stopping:
        console.print(
            f"stopped after iteration {done}; {saver.how_to_continue()}",
            markup=False,
            highlight=False,
        )
    normalizer, policy = jax.device_get((state.normalizer, state.learner.policy))
    return TrainResult(
        agent=make_agent(
            programs.ppo.networks, normalizer, policy, config.eval_deterministic
        ),
        iterations=done,
        exit_code=128 + stopping if stopping else 0,
        had_finished=first >= config.num_iterations,
    )


def _start(
    programs: seeds.Programs,
    config: TrainConfig,
    checkpoints: Checkpointer | None,
    console: Console,
) -> tuple[TrainState, int]:
    """The first state, new or restored, and its finished iterations."""
    nothing = config.resume and checkpoints and not checkpoints.steps
    if nothing:
        console.print(f"{config.resume} has no checkpoint yet and begins anew")
    if checkpoints is None or not config.resume or nothing:
        # donation wants distinct buffers
        return programs.place(programs.init(seeds.keys(config))), 0
    done, state = checkpoints.restore(seeds.shapes(programs.ppo, config), console.print)
    if done >= config.num_iterations:
        console.print(
            f"{config.resume} has finished: {done} iterations; "
            "a larger --num_timesteps continues it"
        )
    return programs.place(state), done


def load_agent(
    env: Env,
    config: TrainConfig,
    folder: Path,
    deterministic: bool,
    note: Note,
    seed_index: int = 0,
    checkpoint: str = NEWEST,
) -> tuple[int, Agent]:
    """Read the policy of a run.

    Args:
        env: The environment it was trained on, or one with the same sizes.
        config: Configuration of the run.
        folder: Run folder.
        deterministic: Act with the mean action.
        note: Called with one line for each damaged checkpoint.
        seed_index: Which agent, if the run trained several seeds.
        checkpoint: `newest`, `best`, or a number.

    Returns:
        Iterations that trained the policy, and the policy.

    Raises:
        CheckpointError: There is no usable checkpoint.
    """
    ppo = make_ppo(env, config)
    whole = seeds.shapes(ppo, config)
    learner = whole.learner.replace(value=None, policy_opt=None, value_opt=None)
    needed = whole.replace(
        learner=learner, scale=None, rollout=None, key=None, iteration=None
    )
    checkpoints = Checkpointer(folder / run_folder.CHECKPOINTS, read_only=True)
    step, state = checkpoints.restore(needed, note, checkpoint)
    checkpoints.close()
    stacked = make_agent(
        ppo.networks, state.normalizer, state.learner.policy, deterministic
    )
    return step, seeds.of_seed(stacked, seed_index, config)
