"""The training loop: iterations, reports, checkpoints, interruptions."""

import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
from rich.console import Console

from rmp_mjx.training import demonstrations
from rmp_mjx.training.config import TrainConfig
from rmp_mjx.training.demonstrations import Demonstrations
from rmp_mjx.training.learning import seeds
from rmp_mjx.training.learning.learner import TrainState
from rmp_mjx.training.learning.networks import Agent, make_agent
from rmp_mjx.training.learning.rollout import Env
from rmp_mjx.training.runs import distributed, identity, run_folder
from rmp_mjx.training.runs.checkpoint import Checkpointer
from rmp_mjx.training.runs.logging import RunLogger
from rmp_mjx.training.runs.metrics import Row, make_rows
from rmp_mjx.training.runs.saving import Commands, Saver, StopRequest, TrainingFailure
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
    env: Env,
    config: TrainConfig,
    folder: Path,
    console: Console | None = None,
    commands: Commands | None = None,
) -> TrainResult:
    """Train a policy, or continue training one.

    Args:
        env: Single environment.
        config: Configuration; `config.run.resume` continues `folder`.
        folder: Run folder, prepared by `run_folder.open_run`.
        console: Terminal.
        commands: The application's commands, for messages; None: it has none.

    Returns:
        The trained policy and how training ended.

    Raises:
        CheckpointError: The run to continue has no usable checkpoint.
        ConfigError: It was trained in another environment.
        TrainingFailure: The simulation or the learner became non-finite, or nothing
            can be saved.
    """
    console = console or Console()
    commands = commands or Commands()
    run_id = identity.new_run()
    if config.run.resume:
        identity.check(identity.saved(folder / run_folder.CONFIG), env, folder)
        run_id = identity.run_id(folder / run_folder.CONFIG)
    demos = _demonstrations(env, config, folder)
    programs = seeds.programs(env, config.ppo, config.run.num_devices)
    seeds.check_memory(programs, config.ppo)
    announce = partial(
        _announce, env, config, folder, run_id, programs.mesh.size, console
    )
    if not config.run.resume:
        announce()
    checkpoints = _open_checkpoints(config, folder, run_id)
    state, first = _start(programs, config, checkpoints, demos, console)
    if config.run.resume:  # a run that cannot go on stays as it is
        announce()
    primary = distributed.is_primary()
    logger = _open_logger(env, config, folder, first, console) if primary else None
    note = logger.note if logger else console.print
    own = checkpoints if primary else None
    saver = Saver(own, folder, note, first, commands)
    watch = Watch(config, env.metrics, folder, note, commands)
    loop = _Loop(config, programs, logger, saver, watch)
    with StopRequest() as stop, logger or nullcontext():
        state, done, stopping = loop.run(state, first, stop)
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
            programs.ppo.networks, normalizer, policy, config.run.eval_deterministic
        ),
        iterations=done,
        exit_code=128 + stopping if stopping else 0,
        had_finished=first >= config.num_iterations,
    )


@dataclass(frozen=True)
class _Loop:
    """The iterations of a run, and what happens after each."""

    config: TrainConfig
    """Configuration."""
    programs: seeds.Programs
    """The compiled parts of an iteration."""
    logger: RunLogger | None
    """Where rows go; None: another process reports."""
    saver: Saver
    """Writes the checkpoints."""
    watch: Watch
    """Looks for bad numbers."""

    def run(
        self, state: TrainState, done: int, stop: StopRequest
    ) -> tuple[TrainState, int, int]:
        """Iterate until the end of the run or a signal to any process.

        Args:
            state: Where to start; it is consumed.
            done: Finished iterations.
            stop: Catches signals.

        Returns:
            The last state, its finished iterations, and the signal or 0.
        """
        config, stopping = self.config, 0
        while done < config.num_iterations and not stopping:
            state, rows = self.iterate(state, done + 1)
            done += 1
            broken = self.report(state, rows)
            stopping = distributed.largest(stop.signal or 0)
            final = bool(done == config.num_iterations or stopping or broken)
            if final or done % config.run.checkpoint_interval == 0:
                self.save(state, done, final, bool(broken))
            if broken:
                raise TrainingFailure(f"{broken}; {self.saver.how_to_continue()}")
        return state, done, stopping

    def iterate(self, state: TrainState, number: int) -> tuple[TrainState, list[Row]]:
        """Gather and learn; the new state and its rows, one for each seed."""
        began = time.monotonic()
        state, data, stats = self.programs.gather(state)
        state, learning = self.programs.learn(state, data)
        jax.block_until_ready(state)
        seconds = time.monotonic() - began
        return state, make_rows(self.config.ppo, number, seconds, stats, learning)

    def report(self, state: TrainState, rows: list[Row]) -> str | None:
        """Log the rows and look for bad numbers; why training must stop, or None."""
        done = int(rows[0]["iteration"] or 0)
        last = done == self.config.num_iterations
        if self.logger and (last or done % self.config.run.log_interval == 0):
            self.logger.add(*rows)
        self.saver.count(rows)
        fault = None
        if any(row["nonfinite_envs"] for row in rows):
            fault = distributed.collected(state.rollout.fault, self.programs.mesh)
        if self.logger:
            self.watch.report(rows, fault)
        return self.watch.abort_reason(rows)

    def save(self, state: TrainState, done: int, final: bool, broken: bool) -> None:
        """Write a checkpoint, unless what was learned is broken itself."""
        if self.logger:
            self.logger.flush()
        if not broken or is_finite(state):
            whole = distributed.collected(state, self.programs.mesh)
            self.saver.save(done, whole, final)


def _open_checkpoints(
    config: TrainConfig, folder: Path, run_id: str | None
) -> Checkpointer | None:
    """The run's checkpoints; None for a process that neither reads nor writes them."""
    primary = distributed.is_primary()
    if not primary and not config.run.resume:
        return None
    place = folder / run_folder.CHECKPOINTS
    kept, forever = config.run.checkpoints_kept, config.run.keep_every
    return Checkpointer(place, kept, forever, not primary, run_id)


def _open_logger(
    env: Env, config: TrainConfig, folder: Path, done: int, console: Console
) -> RunLogger:
    """The logger of a new run, or of one that continues after `done` iterations."""
    after = done * config.ppo.steps_per_iteration if config.run.resume else None
    trackers = open_trackers(config, folder, folder / run_folder.TENSORBOARD, after)
    path = folder / run_folder.METRICS
    return RunLogger(path, env.metrics, config.num_iterations, done, console, trackers)


def _announce(
    env: Env,
    config: TrainConfig,
    folder: Path,
    run_id: str | None,
    devices: int,
    console: Console,
) -> None:
    """Write what the run uses into its folder, and print its devices."""
    changes = []
    if distributed.is_primary():
        changes = run_folder.describe(folder, config, env, run_id)
    console.print(f"training on {run_folder.device(devices)}", highlight=False)
    if changes:
        console.print(f"not an exact continuation: {', '.join(changes)}", markup=False)


def _demonstrations(
    env: Env, config: TrainConfig, folder: Path
) -> Demonstrations | None:
    """What the policy starts from: the file that is named, or a resumed run's copy."""
    if config.ppo.demos is None:
        return None
    copy = folder / run_folder.DEMOS
    found = demonstrations.read(copy if config.run.resume else Path(config.ppo.demos))
    found.check(env)
    return found


def _start(
    programs: seeds.Programs,
    config: TrainConfig,
    checkpoints: Checkpointer | None,
    demos: Demonstrations | None,
    console: Console,
) -> tuple[TrainState, int]:
    """The first state, new or restored, and its finished iterations."""
    nothing = config.run.resume and checkpoints and not checkpoints.steps
    if nothing:
        console.print(f"{config.run.resume} has no checkpoint yet and begins anew")
    if checkpoints is None or not config.run.resume or nothing:
        # donation wants distinct buffers
        state = programs.place(programs.init(seeds.keys(config.ppo)))
        if demos is None:
            return state, 0
        console.print(
            f"cloning {demos.episodes} demonstrations, {len(demos.step):,} steps"
        )
        return programs.clone(state, demos.observation, demos.action), 0
    done, state = checkpoints.restore(
        seeds.shapes(programs.ppo, config.ppo), console.print
    )
    if done >= config.num_iterations:
        console.print(
            f"{config.run.resume} has finished: {done} iterations; "
            "a larger --num_timesteps continues it"
        )
    return programs.place(state), done
