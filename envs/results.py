"""What a finished run leaves: curves, evaluation, pictures, policies."""

import dataclasses
from functools import partial
from pathlib import Path

import jax
import polars as pl
from rich.console import Console

from rmp_mjx.files import write_text
from rmp_mjx.training.config import TrainConfig
from rmp_mjx.training.evaluation import curves, film, report
from rmp_mjx.training.evaluation.learning_curve import (
    Baseline,
    plot_details,
    plot_learning_curve,
)
from rmp_mjx.training.learning import seeds
from rmp_mjx.training.learning.networks import Agent
from rmp_mjx.training.runs import distributed, metrics, policies, run_folder
from rmp_mjx.training.runs.loop import TrainResult

from . import worst
from .base import ArmEnv
from .options import Options


def are_complete(config: TrainConfig, folder: Path) -> bool:
    """Whether a run's folder has all that `finish` writes."""
    last = run_folder.EVALUATION if config.run.eval_episodes else run_folder.CURVE
    policy = run_folder.seed_folders(config, folder)[-1] / run_folder.POLICY
    return (folder / last).exists() and policy.exists()


def finish(
    env: ArmEnv,
    result: TrainResult,
    config: TrainConfig,
    folder: Path,
    console: Console,
) -> None:
    """Plot, evaluate, film and keep every seed's policy; the primary process writes.

    Args:
        env: The environment that the run was trained in.
        result: How training ended.
        config: Configuration of the run.
        folder: Its folder.
        console: Terminal.
    """
    agent = result.agent
    primary = distributed.is_primary()
    if primary:
        plot(env, config, folder)
    if config.run.eval_episodes:
        evaluate_seeds(env, agent, config, folder, console, primary)
    if primary:
        evaluated = config.run.eval_episodes > 0
        policies.save(agent, config, folder, result.iterations, evaluated)
        write_page(folder, console)
    console.print(f"results: {folder}", markup=False, highlight=False)


def write_page(folder: Path, console: Console) -> None:
    """The run on one page of HTML that needs no other file."""
    from rmp_mjx.report.page import page  # loads graphics libraries
    from rmp_mjx.report.runs import grouped, read_run

    try:
        write_text(folder / run_folder.PAGE, page(grouped(read_run(folder))))
    except ValueError as error:  # rows of another trainer
        line = f"no {run_folder.PAGE}: {error}"
        console.print(line, markup=False, highlight=False)


def plot(env: ArmEnv, config: TrainConfig, folder: Path) -> None:
    """The learning curve, and the page of everything else that was recorded."""
    rows = pl.read_parquet(folder / run_folder.METRICS)
    if config.ppo.num_seeds > 1:
        (folder / run_folder.SEEDS).mkdir(exist_ok=True)
        together = metrics.over_seeds(rows, curves.columns(rows))
        together.write_parquet(folder / run_folder.SEED_CURVES)
    found = baseline_rows(config.task)
    baseline = None
    if found is not None:
        label = f"VICES, {found['seed'].n_unique()} seeds, default task"
        baseline = Baseline(label, found)
    picture = folder / run_folder.CURVE
    plot_learning_curve(rows, env.metrics, picture, config.title, baseline)
    plot_details(rows, env.metrics, folder / run_folder.DETAILS, config.title)


def evaluate_seeds(
    env: ArmEnv,
    agent: Agent,
    config: TrainConfig,
    folder: Path,
    console: Console,
    primary: bool,
) -> None:
    """Run the evaluation's episodes with every seed's policy; report them."""
    key = jax.random.key(config.ppo.seed + 1000)
    record = worst.recorder(env, config.run.eval_episodes, config.run.video)
    about = {"agent": "policy", "deterministic": config.run.eval_deterministic}
    columns, films = [], []
    for k, place in enumerate(run_folder.seed_folders(config, folder)):
        results, tape = record(seeds.of_seed(agent, k, config.ppo), key)
        films.append(tape.first(film.EPISODES))
        if primary:
            found = {env.engine: results}
            columns.append(report.save(found, env.metrics, about, place, config.title))
            worst.save(env, tape, results, place)
    if not primary:
        return
    shown = columns[0]
    if config.ppo.num_seeds > 1:
        shown = report.save_over_seeds(columns, about, folder)
    console.print(report.table(shown, config.title, env.metrics))
    if config.run.video:
        from .render import render  # loads graphics libraries

        film.publish(partial(render, env), films[0], env.dt, folder, console)


RESULTS = Path(__file__).parents[1] / "docs/results/store/training.parquet"
"""Training rows of all the paper's runs, in a checkout of the repository."""
VARIANT = "vices"
"""The baseline among them."""
FREE = ("controller", "physics")
"""Options in which a run may differ from the baseline and still be compared."""


def baseline_rows(options: Options, results: Path = RESULTS) -> pl.DataFrame | None:
    """Training rows of VICES on a task, with the column `seed`.

    Args:
        options: Options of the task. The baseline ran with the defaults.
        results: File with the rows.

    Returns:
        The rows; None if the options are not the defaults, or nothing is known.
    """
    changes = {name: getattr(options, name) for name in FREE}
    if options != dataclasses.replace(type(options)(), **changes):
        return None
    if not results.exists():
        return None
    of_task = (pl.col("task") == options.env) & (pl.col("variant") == VARIANT)
    found = pl.scan_parquet(results).filter(of_task).collect()
    if found.is_empty():
        return None
    # All runs of the results have iterations of one size.
    return found.with_columns(iteration=pl.col("steps"))
