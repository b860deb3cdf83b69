"""Evaluate a policy: `eval.py`, and `rmp-mjx-eval` where this is installed."""

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import jax
from rich.console import Console

from rmp_mjx import RobotError, runtime, sim
from rmp_mjx.training.config import ConfigError, TrainConfig
from rmp_mjx.training.evaluation import evaluate, film, report
from rmp_mjx.training.learning import networks
from rmp_mjx.training.runs import identity, policies
from rmp_mjx.training.runs.checkpoint import CheckpointError

from . import cli, registry, worst


def agent_of(
    options: cli.EvalOptions, config: TrainConfig | None, env, console: Console
) -> tuple[int, networks.Agent]:
    """Who acts, and how many iterations of training are behind it."""
    if options.run and config:
        here, there = options.task.robot, config.task.robot
        if here != there:
            console.print(f"trained with the arm '{there}', evaluated with '{here}'")
        return policies.load_agent(
            env,
            config,
            Path(options.run),
            options.deterministic,
            console.print,
            options.seed_index,
            options.checkpoint,
            besides=() if here == there else (identity.ARM,),
        )
    trivial = {"zero": networks.zero_agent, "random": networks.random_agent}
    return 0, trivial[options.agent](env.action_size)


def main(args: Sequence[str] | None = None) -> int:
    """Parse, load, roll out, report; returns the exit code."""
    console = Console()
    try:
        options, config = cli.parse_eval(args)
        for task in options.tasks:
            sim.require(task.physics)
        newer = policies.changed_software(Path(options.run)) if options.run else []
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if newer:
        console.print(f"trained with other software: {', '.join(newer)}")
    runtime.configure(split_cpu=True)
    try:
        env, *others = [registry.make(task) for task in options.tasks]
        evaluate.check_size(env, options.episodes)
        iterations, agent = agent_of(options, config, env, console)
        options.folder.mkdir(parents=True, exist_ok=True)
    except (CheckpointError, ConfigError, RobotError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1 if isinstance(error, CheckpointError) else 2
    key = jax.random.key(options.seed)
    own, tape = worst.recorder(env, options.episodes, options.video)(agent, key)
    results = {env.engine: own} | {
        other.engine: evaluate.run_episodes(other, agent, options.episodes, key)
        for other in others
    }
    about = {
        "agent": options.agent,
        "run": options.run,
        "training_iterations": iterations,
        "task": options.task.record(),
        "deterministic": options.deterministic,
        "seed": options.seed,
    }
    title = f"{options.agent} agent, {options.task.title}, {options.task.spheres}"
    columns = report.save(results, env.metrics, about, options.folder, title)
    worst.save(env, tape, own, options.folder)
    title += f", {options.episodes} episodes"
    console.print(report.table(columns, title, env.metrics))
    if options.video:
        from .render import render  # loads graphics libraries

        shown = tape.first(film.EPISODES)
        film.publish(partial(render, env), shown, env.dt, options.folder, console)
    console.print(f"results: {options.folder}", markup=False, highlight=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
