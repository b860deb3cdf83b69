"""Cells and presets of the paper's grid, and its command line."""

import json

import pytest

from benchmarks.paper import (
    __main__,
    cells,
    deployment,
    store,
    training,
)
from benchmarks.paper.cells import COLUMNS, PAPER, PRESETS, TASKS, Cell
from benchmarks.paper.store import Store
from envs.flags import load_config


def test_a_round_is_one_seed_of_all_six_cells():
    preset = PRESETS["cpu"]
    wanted = preset.cells()
    assert [c.seed for c in wanted] == [seed for seed in range(5) for _ in range(6)]
    first = {(cell.task, cell.variant) for cell in wanted[:6]}
    assert first == {(task, variant) for task in TASKS for variant in PAPER}
    everything = preset.cells(baselines=True)
    assert everything[: len(wanted)] == wanted
    assert {c.variant for c in everything[len(wanted) :]} == set(cells.BASELINES)
    ordered = training.steps(preset, wanted)
    columns = len(preset.columns)
    assert all(step.column is None for step in ordered[:6])
    assert all(step.column for step in ordered[6 : 6 + 6 * columns])
    assert ordered[6 + 6 * columns].cell.seed == 1


def test_presets_hold_to_the_papers_protocol():
    """1.5e6 steps, 64-64; both controllers with the same settings."""
    for name, seeds in (("cpu", 5), ("full", 10)):
        preset = PRESETS[name]
        assert (preset.seeds, preset.training.run.num_timesteps) == (seeds, 1_500_000)
        assert preset.training.ppo.hidden_sizes == (64, 64)
        ours, base = (preset.config(Cell("door", v, 0)) for v in ("rmp_vices", "vices"))
        assert ours.replace(controller="vices") == base


def test_the_results_of_the_repository_are_those_of_the_preset(root):
    """So that `make paper` repeats none of them."""
    place, preset = Store(root / "docs" / "results" / "store"), PRESETS["cpu"]
    for about in place.provenance:
        cell = Cell(about["task"], about["variant"], about["seed"])
        if about["kind"] == store.TRAINING:
            wanted = cells.definition(preset, cell)
            assert training.is_trained(place, preset, cell)
            config = load_config(place.policy(cell))
            assert (config.task, config.ppo) == (
                preset.config(cell).task,
                preset.config(cell).ppo,
            )
        else:
            column = COLUMNS[about["column"]]
            wanted = deployment.definition(preset, cell, column)
        assert about["definition"] == json.loads(json.dumps(wanted)), about


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("door/vices", "TASK/VARIANT/SEED"),
        ("door/vices/0/1", "TASK/VARIANT/SEED"),
        ("window/vices/0", "trajectory, door, push"),
        ("door/vice/0", "rmp_vices_literal"),
        ("door/vices/x", "whole number"),
    ],
)
def test_a_wrong_cell_exits_with_code_2(text, message, capsys):
    assert __main__.main(["--only", text]) == 2
    assert message in capsys.readouterr().err


def test_a_report_of_an_empty_store_exits_with_code_2(tmp_path, capsys):
    assert __main__.main(["--report", "--folder", str(tmp_path)]) == 2
    assert "no finished training" in capsys.readouterr().err
