"""Evaluate a policy: `python eval.py --run RUN --episodes 100 --deterministic`."""

import sys
from collections.abc import Sequence
from pathlib import Path

import jax
from rich.console import Console

import envs
from rmp_mjx import runtime
from rmp_mjx.training import cli, evaluate, networks, report, run_folder
from rmp_mjx.training.checkpoint import CheckpointError
from rmp_mjx.training.config import ConfigError, validate
from rmp_mjx.training.train import load_agent


def main(args: Sequence[str] | None = None) -> int:
    """Parse, load, roll out, report; returns the exit code."""
    console = Console()
    options = cli.parse(cli.EvalConfig, args)
    try:
        config, out = options.resolve()
        validate(config, envs.names())
    except ConfigError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    runtime.configure()
    env = envs.load(config.env, controller=config.controller, physics=config.physics)
    iterations = 0
    if options.run:
        try:
            iterations, agent = load_agent(
                env, config, Path(options.run), options.deterministic, console.print
            )
        except CheckpointError as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
    elif options.agent == "zero":
        agent = networks.zero_agent(env.action_size)
    else:
        agent = networks.random_agent(env.action_size)

    key = jax.random.key(options.seed)
    results = evaluate.run_episodes(env, agent, options.episodes, key)
    summary = evaluate.summarise(results, env.metric_reductions)
    summary |= {
        "agent": options.agent,
        "run": options.run,
        "training_iterations": iterations,
        "env": config.env,
        "controller": config.controller,
        "physics": config.physics,
        "deterministic": options.deterministic,
        "seed": options.seed,
    }
    report.write_json(summary, out / run_folder.EVALUATION)
    title = f"{options.agent} agent, {config.env}, {config.controller}"
    console.print(report.table(summary, title))
    if options.video:
        from envs.render import render  # loads graphics libraries

        video = out / run_folder.VIDEO
        report.film(env, agent, key, video, console, render)
    console.print(f"results: {out}", markup=False, highlight=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
