"""The paper's grid on toy tasks: order, resumption, numbers, pages."""

import dataclasses
import os
import shutil
import signal
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest
from flax import struct
from matplotlib.image import imread
from rich.console import Console
from scipy import stats

from benchmarks.paper import (
    __main__,
    cells,
    deployment,
    measures,
    report,
    store,
    tables,
    targets,
    training,
)
from benchmarks.paper.cells import PRESETS, TASKS, Cell
from benchmarks.paper.store import Store
from envs.cli import make_config
from envs.safety import ENDING
from envs.types import METRICS
from rmp_mjx.pytree import Pytree
from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.policy import load_policy
from rmp_mjx.training.runs import run_folder, saving
from tests.training.toys import ToyState


class Arm(Pytree):
    """A toy with an arm's metrics; VICES collides in a third of its steps."""

    risk: float = struct.field(pytree_node=False)
    observation_size: int = struct.field(pytree_node=False, default=2)
    action_size: int = struct.field(pytree_node=False, default=1)
    dt: float = struct.field(pytree_node=False, default=0.05)
    episode_length: int = struct.field(pytree_node=False, default=6)

    @property
    def metrics(self):
        return METRICS

    def _state(self, key, obs, collision, reward):
        metrics = dict.fromkeys(METRICS, jnp.float32(0.0))
        metrics |= {
            "collision": jnp.float32(collision),
            "contact_force_peak": 40.0 * jnp.float32(collision),
            "clearance": 0.1 - 0.1 * jnp.float32(collision),
            "success": jnp.float32(reward > 0.5),
        }
        done = jnp.float32(collision)
        return ToyState(key, obs, jnp.float32(reward), done, metrics, {})

    def reset(self, rng):
        return self._state(rng, jnp.zeros(2), False, 0.0)

    def step(self, state, action):
        key, draw = jax.random.split(state.data)
        collision = jax.random.uniform(draw) < self.risk
        return self._state(key, state.obs + 0.1, collision, 1.0 - jnp.abs(action[0]))


TINY = dataclasses.replace(
    PRESETS["smoke"],
    training=make_config(
        num_envs=8,
        unroll_length=8,
        num_minibatches=2,
        num_updates_per_batch=1,
        num_timesteps=256,
        hidden_sizes=(4,),
        checkpoint_interval=2,
        eval_episodes=0,
        video=False,
    ),
    options={},
    episodes=20,
    other_episodes=5,
)
QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def toy():
    """Every task is the toy; nothing is drawn; events are not looked into."""
    risk = {"vices": 0.3, "rmp_vices": 0.02}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cells, "load", lambda config: Arm(risk[config.task.controller]))
        patch.setattr(deployment, "describe", lambda env, results, tape: [EVENT])
        patch.setattr(deployment, "save", lambda *args: None)
        deployment._world.cache_clear()
        yield
        deployment._world.cache_clear()


EVENT = {
    "episode": 3,
    "step": 5,
    "kind": "collision",
    "first": "arm/hand",
    "second": "table",
    "hand": True,
    "gap": 0.001,
    "force": 40.0,
}


@pytest.fixture(scope="module")
def grid(toy, tmp_path_factory):
    """A finished grid of two seeds; how often it was stopped, what it said."""
    place = Store(tmp_path_factory.mktemp("paper"))
    said = tmp_path_factory.mktemp("log") / "log"
    with said.open("w") as file:
        code = training.run(place, TINY, TINY.cells(), Console(file=file, width=200))
    assert code == 0
    return Store(place.folder), said.read_text()


@pytest.fixture(scope="module")
def page(grid, tmp_path_factory):
    """The page of the grid."""
    folder = tmp_path_factory.mktemp("page")
    return report.write(Store(grid[0].folder), TINY, folder)


def test_every_cell_is_trained_and_deployed_in_every_column(grid):
    place, said = grid
    assert place.training.select("task", "variant", "seed").unique().height == 12
    counts = place.episodes.group_by("column").len().sort("column")
    assert counts.rows() == [("close", 12 * 20), ("free", 12 * 5)]
    assert "36/36 deploy push/rmp_vices/1: free" in said
    assert ", eta 0 h 00 min" in said
    (one,) = [
        about
        for about in place.provenance
        if about["kind"] == "training"
        and (about["task"], about["variant"], about["seed"]) == ("door", "vices", 1)
    ]
    assert one["definition"]["seed"] == 1
    assert {"git", "jax", "device"} <= one["history"][0].keys()


def test_finished_work_is_not_repeated(grid, monkeypatch):
    def refuse(*args):
        pytest.fail("something was done again")

    monkeypatch.setattr(training, "_do", refuse)
    assert training.run(Store(grid[0].folder), TINY, TINY.cells(), QUIET) == 0


def test_a_damaged_part_is_made_anew_and_a_changed_one_too(grid):
    place, cell = grid[0], Cell("door", "vices", 0)
    path = place.path(store.EPISODES, cell, "free")
    whole = path.read_bytes()
    assert deployment.is_deployed(place, TINY, cell, "free")
    try:
        path.write_bytes(whole[: len(whole) // 2])
        assert not deployment.is_deployed(place, TINY, cell, "free")
    finally:
        path.write_bytes(whole)
    longer = dataclasses.replace(TINY, other_episodes=6)
    assert not deployment.is_deployed(place, longer, cell, "free")
    assert deployment.is_deployed(place, longer, cell, "close")


def test_a_cell_whose_policy_is_damaged_is_not_trained(grid):
    place, cell = grid[0], Cell("door", "vices", 0)
    path = place.policy(cell)
    whole = path.read_bytes()
    assert training.is_trained(place, TINY, cell)
    assert len(whole) < 200_000
    try:
        path.write_bytes(whole[:-1])
        assert not training.is_trained(place, TINY, cell)
    finally:
        path.write_bytes(whole)


def test_a_packed_store_of_other_settings_is_refused(grid, tmp_path):
    grid[0].pack(tmp_path)
    other = dataclasses.replace(TINY, training=TINY.training.replace(gae_lambda=0.5))
    with pytest.raises(ConfigError, match=r"gae_lambda: 0\.97 -> 0\.5"):
        training.run(Store(tmp_path), other, other.cells(), QUIET)


def test_a_run_of_other_settings_is_refused_before_anything_starts(grid, monkeypatch):
    monkeypatch.setattr(training, "_do", lambda *args: pytest.fail("started"))
    other = TINY.training.replace(learning_rate=1e-3)
    other = dataclasses.replace(TINY, training=other)
    with pytest.raises(ConfigError, match=r"learning_rate: 0\.0003 -> 0\.001"):
        training.run(Store(grid[0].folder), other, other.cells(), QUIET)


def test_a_stopped_grid_goes_on_to_the_same_bits(grid, toy, tmp_path, monkeypatch):
    """Stopped in the midst of a cell, by the signal that `seconds` sends."""
    cell = Cell("trajectory", "vices", 0)
    place = Store(tmp_path)
    saves = []
    original = saving.Saver.save

    def save(self, iteration, state, final):
        original(self, iteration, state, final)
        saves.append(iteration)
        if iteration == 2:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(saving.Saver, "save", save)
    wanted = [cell]
    assert training.run(place, TINY, wanted, QUIET) == 128 + signal.SIGTERM
    assert 0 < max(saves) < 4
    assert not place.holds(cells.definition(TINY, cell), store.TRAINING, cell)
    assert training.run(Store(tmp_path), TINY, wanted, QUIET) == 0
    values = [
        measures.of(
            Store(p.folder).training, task=cell.task, variant=cell.variant, seed=0
        ).select(pl.exclude("^time/.*$"))
        for p in (place, grid[0])
    ]
    assert values[0].equals(values[1])
    returns = [
        measures.of(
            Store(p.folder).episodes, task=cell.task, variant=cell.variant, seed=0
        )["return"].to_list()
        for p in (place, grid[0])
    ]
    assert returns[0] == returns[1]


def test_a_run_whose_checkpoints_are_lost_begins_anew(grid, toy, tmp_path):
    cell, place = Cell("push", "rmp_vices", 1), Store(tmp_path)
    folder = place.folder / "runs" / cell.file
    config = TINY.config(cell).replace(run_dir=str(folder))
    _, lock = run_folder.open_run(config)
    run_folder.describe(folder, config, None, None)
    damaged = folder / run_folder.CHECKPOINTS / "2"
    damaged.mkdir(parents=True)
    (damaged / "_CHECKPOINT_METADATA").write_text("nonsense")
    lock.close()
    assert training.run(place, TINY, [cell], QUIET) == 0
    assert len(Store(tmp_path).training) == 4


def test_the_time_given_ends_in_a_signal():
    stopped = threading.Event()
    previous = signal.signal(signal.SIGTERM, lambda *_: stopped.set())
    try:
        with training._alarm(0.01):
            assert stopped.wait(10.0)
        stopped.clear()
        with training._alarm(3600.0):
            pass
        assert not stopped.is_set()
    finally:
        signal.signal(signal.SIGTERM, previous)


def test_the_page_holds_every_target_and_every_figure(grid, page):
    text = page.read_text()
    found = targets.targets(grid[0])
    assert len(found) == len(TASKS) * (3 + 4 * 2)
    assert len({(t.claim, t.task) for t in found}) == len(found)
    for target in found:
        line = f"| {target.claim} | {TASKS[target.task]} | {target.measured or '-'} |"
        assert line in text
    figures = page.parent / report.FIGURES
    for name in ("training", "forces", "pareto", "robustness"):
        assert (figures / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert f"](figures/{name}.png)" in text
    assert len(list(figures.iterdir())) == text.count("](figures/")


def test_the_page_has_the_papers_numbers_beside_ours(grid, page):
    text = page.read_text()
    paper = targets.DEPLOYMENT["vices"]["door"]
    best = targets.best(grid[0], "door", "vices", "close")
    assert best is not None
    hits = int((best["collision"] > 0).sum())
    low, high = stats.binomtest(hits, 20).proportion_ci(method="exact")
    share = f"{5.0 * hits:.1f} {tables.interval((100 * low, 100 * high))}"
    (line,) = [
        x
        for x in text.splitlines()
        if x.startswith("| door opening | VICES |") and "±" in x
    ]
    assert share in line
    assert f"{paper.mean:,.0f} ± {paper.sd:,.0f}; 61; 36" in line


def test_the_page_and_its_figures_are_the_same_from_a_packed_store(
    grid, page, tmp_path
):
    args = ["--folder", str(grid[0].folder), "--pack", str(tmp_path / "store")]
    assert __main__.main(args) == 0
    packed = sorted(path.stem for path in (tmp_path / "store").glob("*.parquet"))
    assert packed == ["episodes", "events", "parts", "training"]
    again = report.write(Store(tmp_path / "store"), TINY, tmp_path / "page")
    assert again.read_text() == page.read_text()
    for path in (page.parent / report.FIGURES).iterdir():
        both = [imread(p.parent / report.FIGURES / path.name) for p in (page, again)]
        assert np.abs(both[0] - both[1]).mean() < 1e-3, path.name  # curves of 32 bits


def test_what_is_packed_is_done_and_a_new_part_comes_before_it(
    grid, tmp_path, monkeypatch
):
    monkeypatch.setattr(training, "_do", lambda *args: pytest.fail("done again"))
    grid[0].pack(tmp_path)
    place, cell = Store(tmp_path), Cell("door", "vices", 0)
    assert place.provenance == grid[0].provenance
    assert not (tmp_path / "policies").exists()  # one file has them all
    found, wanted = (load_policy(each.policy(cell)) for each in (place, grid[0]))
    assert found.about == wanted.about
    assert training.run(place, TINY, TINY.cells(), QUIET) == 0
    rows = measures.of(grid[0].episodes, task="door", variant="vices", seed=0)
    rows = rows.filter(column="free").with_columns(pl.lit(7.0).alias("return"))
    place.write(rows, {"definition": {"episodes": 5}}, store.EPISODES, cell, "free")
    assert not deployment.is_deployed(place, TINY, cell, "free")
    new = Store(tmp_path)
    mine = measures.of(new.episodes, task="door", variant="vices", column="free")
    assert mine.filter(seed=0)["return"].to_list() == [7.0] * 5
    assert len(new.episodes) == len(grid[0].episodes)
    assert len(new.provenance) == len(grid[0].provenance)
    new.pack(tmp_path)
    for kind in store.PACKED:
        shutil.rmtree(tmp_path / kind, ignore_errors=True)
    again = Store(tmp_path).episodes
    assert again["return"].to_list() == new.episodes["return"].to_list()
    assert again["clearance"].null_count() == len(again.filter(column="free"))


def test_the_count_of_targets_is_that_of_the_tables_rows(page):
    text = page.read_text()
    first, _, rest = text.partition("## Every target")
    words = ("met", "NOT MET", "undecided")
    counts = [rest.count(f"| {word} |") for word in words]
    said = "Of {} targets {} are met, {} are not, and {} are undecided."
    assert sum(counts) == 33 and counts[2] < 33
    assert text.count(said.format(33, *counts)) == 2
    assert [first.count(f"| {word} |") for word in words] == [0, *counts[1:]]


def test_the_claim_counts_the_events_of_training(grid, page):
    rows = grid[0].training.with_columns(
        hits=pl.sum_horizontal(f"per_1000_steps/{name}" for name in ENDING)
    )
    steps = rows["steps"].min()  # of an iteration
    events = {
        variant: round(float(measures.of(rows, variant=variant)["hits"].sum()) * steps)
        for variant in ("rmp_vices", "vices")
    }
    ours, base = (round(events[name] / 1000) for name in ("rmp_vices", "vices"))
    assert 0 < ours < base
    said = f"RMP-VICES had {ours:,} events and VICES {base:,}."
    assert said in page.read_text().split("\n\n")[1]


def test_targets_without_measurements_are_said_to_be_unmeasured(grid):
    empty = targets.targets(Store(grid[0].folder / "nothing"))
    assert len(empty) == 33
    assert {t.verdict for t in empty} == {"undecided"}


@pytest.mark.slow
def test_the_smoke_preset_runs_end_to_end(root, tmp_path):
    """The real tasks: minutes, nearly all of them compilation."""
    folder = tmp_path / "store"
    command = [sys.executable, "-m", "benchmarks.paper", "--preset", "smoke"]
    subprocess.run([*command, "--folder", str(folder)], cwd=root, check=True)
    assert (folder / "page" / "index.md").stat().st_size > 10_000
