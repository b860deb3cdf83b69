"""A run of Brax's trainer: its folder, its policy, and a stop."""

import io
import os
import signal

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest
from brax.training.agents.ppo import networks as ppo_networks
from rich.console import Console

from rmp_mjx.training.brax import arguments, trainer
from rmp_mjx.training.config import read_record
from rmp_mjx.training.evaluation import evaluate
from rmp_mjx.training.learning import rollout
from rmp_mjx.training.runs import run_folder
from rmp_mjx.training.runs.logging import RunLogger
from rmp_mjx.training.runs.policies import load_agent
from rmp_mjx.training.runs.stopping import TrainingFailure
from tests.training import toys
from tests.training.conftest import ITERATIONS, SMALL, small


def run(folder, console=None):
    """Train on the counting toy."""
    steps = SMALL["num_envs"] * SMALL["unroll_length"] * ITERATIONS
    config = small(num_timesteps=steps, run_dir=str(folder), trainer="brax")
    folder, lock = run_folder.open_run(config)
    with lock:
        console = console or Console(quiet=True)
        return trainer.train(toys.Counter(), config, folder, console), config


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Folder, result, configuration, what was said, and Brax's own parameters."""
    folder, said = tmp_path_factory.mktemp("brax") / "run", io.StringIO()
    params, keep = [], trainer._Iterations.keep

    def also_keep(self, steps, make_policy, new):
        params.append(new)
        keep(self, steps, make_policy, new)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer._Iterations, "keep", also_keep)
        result, config = run(folder, console=Console(file=said, width=200))
    return folder, result, config, said.getvalue(), params[-1]


def test_a_run_leaves_the_same_folder_as_our_own_loop(trained, finished):
    folder, result, *_ = trained
    assert (result.iterations, result.exit_code) == (ITERATIONS, 0)
    assert read_record(folder / run_folder.CONFIG)["trainer"] == "brax"
    rows, ours = (
        pl.read_parquet(f / run_folder.METRICS) for f in (folder, finished[0])
    )
    learned = [c for c in rows.columns if c.startswith("learning/")]
    assert len(learned) == len(trainer.LEARNING) and set(learned) < set(ours.columns)
    other = [c for c in ours.columns if not c.startswith("learning/")]
    assert [c for c in rows.columns if c not in learned] == other
    assert rows["steps"].to_list() == ours["steps"].to_list()
    assert rows["episode/finished"].sum() > 0
    assert {p.name for p in folder.iterdir()} == {p.name for p in finished[0].iterdir()}


def test_what_brax_does_not_use_is_said_once(trained):
    said = trained[3]
    assert all(said.count(name) == 1 for name in arguments.NOT_IN_BRAX)
    assert "reward_scaling" in said


def test_the_policy_acts_as_braxs_own_and_is_read_from_the_folder(trained):
    folder, result, config, _, params = trained
    env = toys.Counter()
    networks = arguments.arguments(env, config)["network_factory"]()
    brax_policy = ppo_networks.make_inference_fn(networks)(params, deterministic=True)
    obs, key = jax.random.normal(jax.random.key(1), (5, 3)), jax.random.key(2)
    wanted = np.clip(brax_policy(obs, key)[0], -1.0, 1.0)
    iterations, read = load_agent(env, config, folder, True, pytest.fail)
    assert iterations == ITERATIONS
    for agent in (result.agent, read):
        assert np.array_equal(agent(obs, key), wanted)
    assert np.ptp(wanted) > 0.0


def test_the_policy_evaluates(trained):
    results = evaluate.run_episodes(
        toys.Counter(), trained[1].agent, 4, jax.random.key(0)
    )
    assert (results["length"] > 0).all()


def test_a_signal_ends_it_after_the_iteration_with_all_saved(tmp_path, monkeypatch):
    add = RunLogger.add

    def stop_at_three(self, row):
        add(self, row)
        if row["iteration"] == 3:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(RunLogger, "add", stop_at_three)
    said = io.StringIO()
    result, config = run(tmp_path / "run", console=Console(file=said, width=200))
    assert (result.iterations, result.exit_code) == (3, 128 + signal.SIGINT)
    assert "stopped after iteration 3" in said.getvalue()
    assert "--resume" not in said.getvalue()
    folder = tmp_path / "run"
    assert load_agent(toys.Counter(), config, folder, True, pytest.fail)[0] == 3
    assert len(pl.read_parquet(folder / run_folder.METRICS)) == 3


def test_losses_that_become_nonfinite_end_it_unsaved(tmp_path, monkeypatch):
    def one_bad_step(environment, progress_fn, policy_params_fn, **given):
        environment._report(rollout.init_stats(toys.Counter(), 1))
        policy_params_fn(64, None, None)
        progress_fn(64, dict.fromkeys(trainer.LEARNING.values(), jnp.nan))

    monkeypatch.setattr(trainer.brax_ppo, "train", one_bad_step)
    with pytest.raises(TrainingFailure, match="non-finite; nothing is saved"):
        run(tmp_path / "run")
    assert not list((tmp_path / "run" / run_folder.CHECKPOINTS).glob("[0-9]*"))
