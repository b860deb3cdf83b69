"""Train a policy: `python train.py --env trajectory --controller rmp_vices`."""

import sys
from collections.abc import Sequence

import jax
from rich.console import Console

import envs
from rmp_mjx import runtime
from rmp_mjx.training import cli, evaluate, report, run_folder
from rmp_mjx.training.checkpoint import CheckpointError
from rmp_mjx.training.config import ConfigError, TrainConfig, validate
from rmp_mjx.training.train import TrainingFailure, train


def finish(env, agent, config: TrainConfig, folder, console: Console) -> None:
    """Evaluate, plot and film a trained policy."""
    key = jax.random.key(config.seed + 1000)
    title = f"{config.env}, {config.controller}, seed {config.seed}"
    report.plot_learning_curve(
        folder / run_folder.METRICS, folder / run_folder.CURVE, title
    )
    if config.eval_episodes:
        results = evaluate.run_episodes(env, agent, config.eval_episodes, key)
        summary = evaluate.summarise(results, env.metric_reductions)
        summary |= {"agent": "policy", "deterministic": config.eval_deterministic}
        report.write_json(summary, folder / run_folder.EVALUATION)
        console.print(report.table(summary, title))
    if config.video:
        from envs.render import render  # loads graphics libraries

        video = folder / run_folder.VIDEO
        report.film(env, agent, key, video, console, render)
    console.print(f"results: {folder}", markup=False, highlight=False)


def main(args: Sequence[str] | None = None) -> int:
    """Parse, check, train, evaluate; returns the exit code."""
    console = Console()
    try:
        config = validate(cli.parse_train(args), envs.names())
        folder, lock = run_folder.open_run(config)
    except ConfigError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    with lock:
        runtime.configure()
        env = envs.load(
            config.env, controller=config.controller, physics=config.physics
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
