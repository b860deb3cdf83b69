"""The baseline that a run is compared with: the same task, or none."""

import polars as pl
import pytest

import envs
from envs import results as outcome


@pytest.fixture
def results(tmp_path):
    file = tmp_path / "training.parquet"
    pl.DataFrame(
        {
            "task": ["push", "push", "push", "door"],
            "variant": ["vices", "vices", "osc", "vices"],
            "seed": [0, 1, 0, 0],
            "steps": [10, 10, 10, 10],
        }
    ).write_parquet(file)
    return file


def test_vices_rows_of_the_task_are_found(results):
    options = envs.make_options("push", controller="rmp_vices", physics="mjx")
    found = outcome.baseline_rows(options, results)
    assert found is not None
    assert found["seed"].to_list() == [0, 1]
    assert set(found["task"]) == {"push"} and set(found["variant"]) == {"vices"}


def test_another_task_and_other_options_have_no_baseline(results, tmp_path):
    assert outcome.baseline_rows(envs.make_options("trajectory"), results) is None
    assert (
        outcome.baseline_rows(envs.make_options("push", obstacles=2), results) is None
    )
    default = envs.make_options("push")
    assert outcome.baseline_rows(default, tmp_path / "missing.parquet") is None
