"""Logs, tables and plots."""

import io

import numpy as np
import polars as pl
import pytest
from rich.console import Console

from rmp_mjx.training.evaluation import figures, report
from rmp_mjx.training.runs.logging import RunLogger


def rows(first, last):
    for k in range(first, last + 1):
        yield {
            "iteration": k,
            "steps": 10 * k,
            "time/steps_per_s": 1000.0,
            "episode/return": None if k % 2 else 1.0 * k,
            "per_1000_steps/collision": 0.5,
        }


def log(path, first, last, total=20, console=None):
    console = console or Console(file=io.StringIO(), width=200)
    with RunLogger(path / "m.parquet", total, first - 1, console) as logger:
        for row in rows(first, last):
            logger.add(row)


def test_a_resumed_log_drops_what_will_be_repeated(tmp_path):
    log(tmp_path, 1, 5)
    log(tmp_path, 4, 7)
    found = pl.read_parquet(tmp_path / "m.parquet")
    assert found["iteration"].to_list() == [1, 2, 3, 4, 5, 6, 7]
    assert found["episode/return"].to_list() == [None, 2, None, 4, None, 6, None]


def test_without_a_terminal_the_log_is_a_few_lines(tmp_path):
    text = io.StringIO()
    log(tmp_path, 1, 20, console=Console(file=text, width=200))
    lines = text.getvalue().splitlines()
    # "compiling", the first and the last; one more on a slow machine
    assert len(lines) <= 4
    assert "20/20" in lines[-1]
    assert "return 20.0" in lines[-1]
    assert "coll/1k 0.50" in lines[-1]


def test_a_terminal_sees_progress_and_the_time_left(tmp_path):
    text = io.StringIO()
    log(tmp_path, 1, 20, console=Console(file=text, width=200, force_terminal=True))
    assert "20/20" in text.getvalue()
    assert "eta" in text.getvalue()


def test_the_learning_curve_is_a_picture_of_every_episode_value(tmp_path):
    log(tmp_path, 1, 20)
    figures.plot_learning_curve(tmp_path / "m.parquet", tmp_path / "c.png", "title")
    assert (tmp_path / "c.png").read_bytes().startswith(b"\x89PNG")


def printed(columns, own=()):
    text = io.StringIO()
    Console(file=text, width=80).print(report.table(columns, "a title [N]", own))
    return text.getvalue()


SUMMARY = {
    "return_mean": 12345.6,
    "return_sd": 78.9,
    "success_rate": 0.5,
    "success_rate_ci95": [0.25, 0.75],
    "clearance_min": 0.0123,
    "laps_mean": 1.5,
    "lost_episodes": 0,
}


def test_the_table_shows_the_return_first_and_intervals_beside_their_rates():
    said = printed({"toy": SUMMARY}, ["laps"])
    rows = [line.strip("│ ") for line in said.splitlines() if "│" in line]
    assert rows[0].startswith("return, mean +- sd") and "12,346 +- 78.9" in rows[0]
    assert "50 [25, 75]" in said
    assert "[mm]" in said and "12.3" in said  # rich does not take units for its markup
    assert "laps" in said and "a title [N]" in said
    assert "lost" not in said


def test_two_engines_stand_side_by_side_with_what_went_wrong_below():
    other = SUMMARY | {"success_rate": 0.25, "lost_episodes": 3}
    said = printed({"one": SUMMARY, "two": other})
    row = next(line for line in said.splitlines() if "success" in line)
    assert row.index("50 [") < row.index("25 [25, ")
    assert "episodes lost to a non-finite state: 3 (two)" in said


@pytest.mark.parametrize("touched", [True, False])
def test_histograms_are_pictures_with_or_without_contact(tmp_path, touched):
    peaks = {"one": np.array([0.0, 30.0 * touched]), "two": np.zeros(3)}
    figures.plot_forces(peaks, tmp_path / "f.png", "title")
    figures.plot_clearances(
        {"one": np.array([0.1, -0.01])}, tmp_path / "c.png", "title"
    )
    for name in ("f.png", "c.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
