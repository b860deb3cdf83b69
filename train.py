"""Train a policy: `python train.py --env trajectory --controller rmp_vices`."""

import sys
from collections.abc import Sequence
from functools import partial

import jax
from rich.console import Console

import envs
from eval import engine
from rmp_mjx import runtime
from rmp_mjx.training import cli, evaluate, figures, film, report, run_folder
from rmp_mjx.training.checkpoint import CheckpointError
from rmp_mjx.training.config import TrainConfig, validate
from rmp_mjx.training.train import TrainingFailure, train


def finish(env, agent, config: TrainConfig, folder, console: Console) -> None:
    """Evaluate, plot and film a trained policy."""
    title = f"{config.env}, {config.controller}, seed {config.seed}"
    figures.plot_learning_curve(
        folder / run_folder.METRICS, folder / run_folder.CURVE, title
    )
    if config.eval_episodes:
        key = jax.random.key(config.seed + 1000)
        filmed = film.EPISODES if config.video else 0
        results, tape = evaluate.record_episodes(
            env, agent, config.eval_episodes, key, filmed
        )
        about = {"agent": "policy", "deterministic": config.eval_deterministic}
        columns = report.save(
            {engine(env): results}, env.metric_reductions, about, folder, title
        )
        console.print(report.table(columns, title, env.task_metrics))
        if config.video:
            from envs.render import render  # loads graphics libraries

            film.publish(partial(render, env), tape, env.dt, folder, console)
    console.print(f"results: {folder}", markup=False, highlight=False)


def main(args: Sequence[str] | None = None) -> int:
    """Parse, check, train, evaluate; returns the exit code."""
    console = Console()
    try:
        config = validate(cli.parse_train(args), envs.names())
        options = envs.parse_options(config.env, config.env_options)
        folder, lock = run_folder.open_run(config)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    with lock:
        runtime.configure()
        env = envs.load(
            config.env,
            controller=config.controller,
            physics=config.physics,
            **options,
        )
        try:
            result = train(env, config, folder, console)
        except (CheckpointError, TrainingFailure) as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
        if not result.exit_code and not result.had_finished:
            finish(env, result.agent, config, folder, console)
        return result.exit_code


if __name__ == "__main__":
    sys.exit(main())
