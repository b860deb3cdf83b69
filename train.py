"""Train a policy: `python train.py --env trajectory --controller rmp_vices`."""

import sys
from collections.abc import Sequence
from functools import partial

import jax
import polars as pl
from rich.console import Console

import envs
from envs import baselines, cli, grid
from rmp_mjx import runtime, sim
from rmp_mjx.training.config import ConfigError, TrainConfig
from rmp_mjx.training.evaluation import curves, evaluate, film, report
from rmp_mjx.training.evaluation.learning_curve import (
    Baseline,
    plot_details,
    plot_learning_curve,
)
from rmp_mjx.training.learning import seeds
from rmp_mjx.training.runs import distributed, metrics, policies, run_folder
from rmp_mjx.training.runs.checkpoint import CheckpointError
from rmp_mjx.training.runs.commands import Commands
from rmp_mjx.training.runs.loop import TrainingFailure, TrainResult, train

COMMANDS = Commands(resume="python train.py --resume", replay="python -m envs.replay")
"""What messages of a run tell its user to type."""


def finish(
    env, result: TrainResult, config: TrainConfig, folder, console: Console
) -> None:
    """Plot, evaluate, film and keep every seed's policy; the primary process writes."""
    agent = result.agent
    primary = distributed.is_primary()
    if primary:
        plot(env, config, folder)
    if config.run.eval_episodes:
        evaluate_seeds(env, agent, config, folder, console, primary)
    if primary:
        evaluated = config.run.eval_episodes > 0
        policies.save(agent, config, folder, result.iterations, evaluated)
    console.print(f"results: {folder}", markup=False, highlight=False)


def plot(env, config: TrainConfig, folder) -> None:
    """The learning curve, and the page of everything else that was recorded."""
    rows = pl.read_parquet(folder / run_folder.METRICS)
    if config.ppo.num_seeds > 1:
        (folder / run_folder.SEEDS).mkdir(exist_ok=True)
        together = metrics.over_seeds(rows, curves.columns(rows))
        together.write_parquet(folder / run_folder.SEED_CURVES)
    found = baselines.rows(config.task)
    baseline = None
    if found is not None:
        label = f"VICES, {found['seed'].n_unique()} seeds, default task"
        baseline = Baseline(label, found)
    picture = folder / run_folder.CURVE
    plot_learning_curve(rows, env.metrics, picture, config.title, baseline)
    plot_details(rows, env.metrics, folder / run_folder.DETAILS, config.title)


def evaluate_seeds(
    env, agent, config: TrainConfig, folder, console: Console, primary: bool
) -> None:
    """Run the evaluation's episodes with every seed's policy; report them."""
    key = jax.random.key(config.ppo.seed + 1000)
    filmed = film.EPISODES if config.run.video else 0
    record = evaluate.recorder(env, config.run.eval_episodes, filmed)
    about = {"agent": "policy", "deterministic": config.run.eval_deterministic}
    columns, tapes = [], []
    for k, place in enumerate(run_folder.seed_folders(config, folder)):
        results, tape = record(seeds.of_seed(agent, k, config.ppo), key)
        tapes.append(tape)
        if primary:
            found = {env.engine: results}
            columns.append(report.save(found, env.metrics, about, place, config.title))
    if not primary:
        return
    shown = columns[0]
    if config.ppo.num_seeds > 1:
        shown = report.save_over_seeds(columns, about, folder)
    console.print(report.table(shown, config.title, env.metrics))
    if config.run.video:
        from envs.render import render  # loads graphics libraries

        film.publish(partial(render, env), tapes[0], env.dt, folder, console)


def _train(env, config: TrainConfig, folder, console: Console) -> TrainResult:
    """Train with the trainer that the configuration names."""
    if config.trainer == "ours":
        return train(env, config, folder, console, COMMANDS)
    from rmp_mjx.training.brax import trainer  # loads all of Brax's environments

    return trainer.train(env, config, folder, console)


def run(config: TrainConfig, console: Console) -> int:
    """Train and evaluate one configuration; returns the exit code."""
    try:
        folder, lock = distributed.open_run(config)
    except ConfigError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    with lock:
        runtime.configure(split_cpu=distributed.alone())
        env = envs.make(config.task)
        try:
            result = _train(env, config, folder, console)
        except (CheckpointError, TrainingFailure, ConfigError) as error:
            print(f"error: {error}", file=sys.stderr)
            return 2 if isinstance(error, ConfigError) else 1
        last = run_folder.EVALUATION if config.run.eval_episodes else run_folder.CURVE
        policy = run_folder.seed_folders(config, folder)[-1] / run_folder.POLICY
        reported = result.had_finished and (folder / last).exists() and policy.exists()
        if not result.exit_code and not reported:
            finish(env, result, config, folder, console)
        return result.exit_code


def main(args: Sequence[str] | None = None) -> int:
    """Parse, check, train, evaluate; returns the exit code."""
    console = Console()
    try:
        options, wanted = cli.parse_train(args)
        configs = list(wanted.cells().values()) if wanted else [options.config]
        for config in configs:
            sim.require(config.task.physics)
        distributed.join(**vars(options.processes))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if not distributed.alone():
        runtime.configure()
        console = Console(quiet=not distributed.is_primary())
    if wanted:
        return grid.run(wanted, partial(run, console=console), console)
    return run(configs[0], console)


if __name__ == "__main__":
    sys.exit(main())
