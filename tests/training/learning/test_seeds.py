"""Several seeds in one program against each of them alone."""

import functools
import json

import jax
import numpy as np
import polars as pl
import pytest

from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.evaluation.evaluate import over_seeds
from rmp_mjx.training.learning import devices, seeds
from rmp_mjx.training.learning.ppo import make_ppo
from rmp_mjx.training.runs import metrics, run_folder
from rmp_mjx.training.runs.policies import load_agent
from tests.training import toys
from tests.training.conftest import ITERATIONS, bits, run, small

FIRST, COUNT = 3, 3


@functools.cache
def trained(seed, count):
    """State and last learning metrics of `count` seeds after a few iterations."""
    config = small(seed=seed, num_seeds=count).ppo
    programs = seeds.programs(toys.Counter(), config)
    state = programs.place(programs.init(seeds.keys(config)))
    stats = learning = None
    for _ in range(ITERATIONS):
        state, data, stats = programs.gather(state)
        state, learning = programs.learn(state, data)
    return jax.device_get((state, stats, learning)), config


@pytest.mark.parametrize("k", range(COUNT))
def test_a_seed_among_others_learns_what_it_learns_alone(k):
    """To float32 rounding: the sums of a batched product have another order."""
    together, config = trained(FIRST, COUNT)
    alone, _ = trained(FIRST + k, 1)
    for one, two in zip(
        jax.tree.leaves(seeds.of_seed(together, k, config)),
        jax.tree.leaves(alone),
        strict=True,
    ):
        if jax.numpy.issubdtype(one.dtype, jax.dtypes.prng_key):
            assert bits(one) == bits(two)
        else:
            np.testing.assert_allclose(
                np.asarray(one, float), np.asarray(two, float), rtol=1e-5, atol=1e-5
            )


def test_the_seeds_differ_from_each_other():
    (state, _, _), _ = trained(FIRST, COUNT)
    for leaf in (state.key.reshape(-1), *jax.tree.leaves(state.learner.policy)):
        assert bits(leaf[0]) != bits(leaf[1])


def test_resets_stay_a_branch_for_several_seeds():
    """As a select, every step of every environment would pay for a reset."""
    config = small(num_seeds=2).ppo
    ppo = make_ppo(toys.Counter(), config)
    program = jax.make_jaxpr(jax.vmap(ppo.gather))(seeds.shapes(ppo, config))
    assert " cond[" in str(program)


@pytest.fixture(scope="module")
def several(tmp_path_factory):
    """Folder and configuration of an uninterrupted run of two seeds."""
    folder = tmp_path_factory.mktemp("runs") / "several"
    _, config = run(folder, num_seeds=2)
    return folder, config


def test_every_seed_has_its_rows(several):
    rows = pl.read_parquet(several[0] / run_folder.METRICS)
    assert rows["seed"].to_list() == [0, 1] * ITERATIONS
    assert rows["iteration"].to_list() == [k for k in range(1, 5) for _ in range(2)]
    last = rows.filter(pl.col("iteration") == ITERATIONS)
    assert last["steps"].to_list() == [256, 256]
    assert last["episode/return"].n_unique() == 2 or last["learning/kl"].n_unique() == 2


def test_a_resumed_run_of_several_seeds_is_bit_identical(several, tmp_path):
    folder, config = several
    other = tmp_path / "interrupted"
    half = config.ppo.steps_per_iteration * ITERATIONS // 2
    run(other, num_seeds=2, num_timesteps=half)
    run(other, num_seeds=2, run_dir=None, resume=str(other))
    rows, reference = (
        pl.read_parquet(f / run_folder.METRICS).select(pl.exclude("^time/.*$"))
        for f in (other, folder)
    )
    assert rows.equals(reference)
    obs = jax.random.normal(jax.random.key(0), (5, 3))
    for k in range(2):
        agents = [
            load_agent(toys.Counter(), config, f, True, pytest.fail, k)[1]
            for f in (other, folder)
        ]
        one, same = (agent(obs, jax.random.key(1)) for agent in agents)
        np.testing.assert_array_equal(one, same)


def test_the_agents_of_a_run_are_told_apart(several):
    folder, config = several
    obs = jax.random.normal(jax.random.key(0), (5, 3))
    one, two = (
        load_agent(toys.Counter(), config, folder, True, pytest.fail, k)[1]
        for k in range(2)
    )
    assert not np.array_equal(one(obs, jax.random.key(1)), two(obs, jax.random.key(1)))


def rows_of(values):
    """Metrics of seeds 0, 1, ... with the given returns by iteration."""
    return [
        {"seed": k, "iteration": t + 1, "steps": 10 * (t + 1), "episode/return": x}
        for t, column in enumerate(zip(*values, strict=True))
        for k, x in enumerate(column)
    ]


def test_an_iteration_of_all_seeds_is_the_mean_of_the_middle_half():
    rows = rows_of([[0.0], [4.0], [6.0], [1000.0], [None]])
    row = metrics.of_all_seeds(rows)
    assert row == {"iteration": 1, "steps": 10, "episode/return": 5.0}


def test_curves_over_seeds_keep_the_last_value_where_no_episode_finished():
    table = pl.DataFrame(rows_of([[None, 1.0, None, 3.0], [5.0, 5.0, 5.0, 5.0]]))
    curves = metrics.over_seeds(table, ["episode/return"])
    assert curves["steps"].to_list() == [10, 20, 30, 40]
    assert curves["episode/return"].to_list() == [None, 3.0, 3.0, 4.0]
    low, high = curves["episode/return_low"], curves["episode/return_high"]
    # two seeds: the bootstrap draws the lower twice, the upper twice, or both
    assert (low[1], high[1]) == (1.0, 5.0) and (low[3], high[3]) == (3.0, 5.0)


def test_evaluations_of_seeds_combine_by_interquartile_mean_and_sum():
    summaries = [
        {
            "episodes": 10,
            "return_mean": x,
            "return_mean_ci95": [x - 1.0, x + 1.0],
            "return_sd": 2.0,
        }
        for x in (1.0, 2.0, 4.0, 90.0)
    ]
    found = over_seeds(summaries)
    assert (found["episodes"], found["seeds"]) == (40, 4)
    assert found["return_mean"] == 3.0
    low, high = found["return_mean_ci95"]
    assert 1.0 <= low < 3.0 < high <= 90.0
    assert found["return_sd"] == pytest.approx(np.std([1, 2, 4, 90], ddof=1))
    json.dumps(found)


LARGE = {
    "num_envs": 2**30,
    "unroll_length": 2**30,
    "num_seeds": 2**30,
    "hidden_sizes": (2**30, 2**30),
}


@pytest.mark.parametrize("name", [*LARGE, "all"])
def test_a_training_that_cannot_fit_is_refused_with_the_estimate(name):
    config = small(**(LARGE if name == "all" else {name: LARGE[name]})).ppo
    programs = seeds.programs(toys.Counter(), config)
    with pytest.raises(ConfigError, match=r"at least [\d,.]+ GiB of memory"):
        seeds.check_memory(programs, config)


def test_the_estimate_is_what_is_held_at_least(monkeypatch):
    config, needed = small().ppo, []
    programs = seeds.programs(toys.Counter(), config)
    monkeypatch.setattr(devices, "check_memory", lambda *given: needed.append(given[0]))
    seeds.check_memory(programs, config)
    state, data, _ = programs.gather(programs.init(seeds.keys(config)))
    nbytes = [sum(x.nbytes for x in jax.tree.leaves(each)) for each in (state, data)]
    assert needed == [nbytes[0] + 2 * nbytes[1]]
