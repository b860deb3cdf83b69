"""Evaluate a policy: `python eval.py --run RUN --obstacles 2 --layout close`."""

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import jax
from rich.console import Console

import envs
from envs import cli
from rmp_mjx import runtime, sim
from rmp_mjx.training.config import validate
from rmp_mjx.training.evaluation import evaluate, film, report
from rmp_mjx.training.learning import networks
from rmp_mjx.training.runs import run_folder
from rmp_mjx.training.runs.checkpoint import CheckpointError
from rmp_mjx.training.runs.loop import load_agent


def engine(env: envs.ArmEnv) -> str:
    """Physics engine, timestep and friction cone of a task."""
    name = next(n for n, kind in sim.ENGINES.items() if isinstance(env.physics, kind))
    return f"{name}, {1e3 * env.options.sim_dt:g} ms, {env.options.cone}"


def spheres(env: envs.ArmEnv) -> str:
    """Obstacles of a task and their layout."""
    asked = env.options
    if not asked.obstacles:
        return "no obstacles"
    extra = [
        f", {name} {value:g}"
        for name in ("speed", "noise", "delay")
        if (value := getattr(asked, f"obstacle_{name}"))
    ]
    return f"{asked.obstacles} spheres ({asked.layout}{''.join(extra)})"


def main(args: Sequence[str] | None = None) -> int:
    """Parse, load, roll out, report; returns the exit code."""
    console = Console()
    options = cli.parse(cli.EvalConfig, args)
    try:
        configs, out = options.resolve()
        config = validate(configs[0], envs.names())
        for asked in configs:
            sim.require(asked.physics)
        settings = [envs.parse_options(c.env, c.env_options) for c in configs]
        newer = run_folder.changed_software(Path(options.run)) if options.run else []
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if newer:
        console.print(f"trained with other software: {', '.join(newer)}")
    runtime.configure(split_cpu=True)
    tasks = [
        envs.load(c.env, controller=c.controller, physics=c.physics, **setting)
        for c, setting in zip(configs, settings, strict=True)
    ]
    env, iterations = tasks[0], 0
    if options.run:
        try:
            iterations, agent = load_agent(
                env,
                config,
                Path(options.run),
                options.deterministic,
                console.print,
                options.seed_index,
                options.checkpoint,
            )
        except CheckpointError as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
    elif options.agent == "zero":
        agent = networks.zero_agent(env.action_size)
    else:
        agent = networks.random_agent(env.action_size)

    key = jax.random.key(options.seed)
    filmed = film.EPISODES if options.video else 0
    own, tape = evaluate.record_episodes(env, agent, options.episodes, key, filmed)
    results = {engine(env): own} | {
        engine(task): evaluate.run_episodes(task, agent, options.episodes, key)
        for task in tasks[1:]
    }
    about = {
        "agent": options.agent,
        "run": options.run,
        "training_iterations": iterations,
        "env": config.env,
        "controller": config.controller,
        "env_options": settings[0],
        "deterministic": options.deterministic,
        "seed": options.seed,
    }
    title = f"{options.agent} agent, {config.env}, {config.controller}, {spheres(env)}"
    columns = report.save(results, env.metric_reductions, about, out, title)
    title += f", {options.episodes} episodes"
    console.print(report.table(columns, title, env.task_metrics))
    if options.video:
        from envs.render import render  # loads graphics libraries

        film.publish(partial(render, env), tape, env.dt, out, console)
    console.print(f"results: {out}", markup=False, highlight=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
