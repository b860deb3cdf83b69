"""Environments that become non-finite: left out, counted, written down, replayed."""

import io

import jax
import numpy as np
import polars as pl
import pytest
from rich.console import Console

from rmp_mjx.metric import Metric, by_name
from rmp_mjx.training.learning import faults
from rmp_mjx.training.learning.ppo import make_ppo
from rmp_mjx.training.runs import run_folder, watch
from rmp_mjx.training.runs.loop import train
from rmp_mjx.training.runs.saving import Commands
from tests.training import toys
from tests.training.conftest import SMALL, bits, small

CONFIG = small()
ITERATIONS = 4
OPTIMISED = {"xla_backend_optimization_level": 3}
"""As users compile."""


def iterations(env):
    """State, and the count of bad steps, after a few iterations."""
    ppo = make_ppo(env, CONFIG.ppo)
    state = jax.jit(ppo.init)(jax.random.key(0))
    iterate, bad = jax.jit(ppo.iterate, compiler_options=OPTIMISED), 0
    for _ in range(ITERATIONS):
        state, stats, _ = iterate(state)
        bad += int(stats.nonfinite)
    return state, bad


@pytest.fixture(scope="module")
def flagged():
    """The environment itself says which lanes are bad; all of its numbers are good."""
    return iterations(toys.Poisoned(flag=True))


@pytest.mark.parametrize("poison", [np.nan, 1e30])
def test_bad_numbers_change_nothing_but_that_their_steps_are_left_out(flagged, poison):
    """Bit for bit what a run with the same lanes masked by a flag learns."""
    state, bad = iterations(toys.Poisoned(poison=poison))
    assert bad == flagged[1] > 3
    for part in ("learner", "normalizer", "scale", "key"):
        one, two = (getattr(s, part) for s in (state, flagged[0]))
        assert jax.tree.map(bits, one) == jax.tree.map(bits, two)


def test_without_poison_it_learns_something_else(flagged):
    state, bad = iterations(toys.Poisoned())
    assert bad == 0
    one, two = (jax.tree.map(bits, s.learner) for s in (state, flagged[0]))
    assert one != two


@pytest.fixture(scope="module")
def poisoned(tmp_path_factory):
    """A run with bad steps: its folder and what it said."""
    folder = tmp_path_factory.mktemp("poisoned") / "run"
    config = small(num_timesteps=64 * 8, run_dir=str(folder))
    folder, lock = run_folder.open_run(config)
    text = io.StringIO()
    with lock:
        console = Console(file=text, width=200)
        env = toys.Poisoned(poison=np.nan)
        train(env, config, folder, console, Commands(replay="replay"))
    return folder, text.getvalue()


def test_bad_steps_are_counted_said_once_and_a_few_are_written(poisoned):
    folder, said = poisoned
    counted = pl.read_parquet(folder / run_folder.METRICS)["nonfinite_envs"]
    files = sorted((folder / run_folder.NONFINITE).glob("*.npz"))
    assert counted.sum() > len(files) == watch.MAX_DUMPS
    assert said.count("became non-finite") == 1
    assert f"inspect one with\n  replay {folder / run_folder.NONFINITE}" in said


def test_a_written_step_becomes_bad_again(poisoned):
    folder, _ = poisoned
    env = toys.Poisoned(poison=np.nan)
    template = jax.eval_shape(env.reset, jax.random.key(0))
    for path in (folder / run_folder.NONFINITE).glob("*.npz"):
        state, action = faults.load(path, template)
        assert jax.tree.structure(state) == jax.tree.structure(template)
        assert np.isfinite(state.obs).all()
        assert np.isnan(env.step(state, action).obs).any()
        said = faults.about(path)
        assert said["config"]["task"]["env"] == "counter"
        assert said["iteration"] >= 1 and 0 <= said["lane"] < SMALL["num_envs"]


def test_what_is_no_dump_or_of_another_task_is_refused(poisoned, tmp_path):
    path = next((poisoned[0] / run_folder.NONFINITE).glob("*.npz"))
    with pytest.raises(ValueError, match=r"of another task: .*data"):
        faults.load(path, {"data": jax.ShapeDtypeStruct((), float)})
    (tmp_path / "text.npz").write_text("no arrays")
    with pytest.raises(ValueError, match="is no dump"):
        faults.about(tmp_path / "text.npz")


def row(**changes):
    values = {"iteration": 7, "nonfinite_envs": 0, "learning/skipped_updates": 0.0}
    return values | {"episode/contact_overflow": None} | changes


def test_a_metric_that_means_a_fault_is_said_once(tmp_path):
    notes = []
    metrics = by_name([Metric("contact_overflow", "max", fault="forces too low")])
    watching = watch.Watch(CONFIG, metrics, tmp_path, notes.append, Commands())
    for share in (None, 0.0, 0.25, 0.5):
        watching.report([row(**{"episode/contact_overflow": share})], None)
    (said,) = notes
    assert said == "warning: forces too low (column episode/contact_overflow)"


def test_training_goes_on_with_some_skipped_updates_and_not_without_any_other(tmp_path):
    watching = watch.Watch(CONFIG, {}, tmp_path, pytest.fail, Commands())
    updates = CONFIG.ppo.num_updates_per_batch * CONFIG.ppo.num_minibatches
    some, all_of_them = (
        row(**{"learning/skipped_updates": float(n)}) for n in (updates - 1, updates)
    )
    assert watching.abort_reason([some]) is None
    reason = watching.abort_reason([some, all_of_them])
    assert reason is not None and "non-finite gradients" in reason
