"""The rows of a run: kept, shown on the terminal."""

import io

import polars as pl
import pytest
from rich.console import Console

from rmp_mjx.metric import SUCCESS, Metric, by_name
from rmp_mjx.training.runs.logging import RunLogger, headline

METRICS = by_name([SUCCESS, Metric("collision", "sum", event=True, headline="coll")])


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
    with RunLogger(path / "m.parquet", METRICS, total, first - 1, console) as logger:
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
    assert "return 20 " in lines[-1]
    assert "coll/1k 0.50" in lines[-1]


def test_a_terminal_sees_progress_and_the_time_left(tmp_path):
    text = io.StringIO()
    log(tmp_path, 1, 20, console=Console(file=text, width=200, force_terminal=True))
    assert "20/20" in text.getvalue()
    assert "eta" in text.getvalue()


@pytest.mark.parametrize(
    ("metric", "value", "shown"),
    [
        (SUCCESS, 0.971, "success 97.1%"),
        (METRICS["collision"], 0.5, "coll/1k 0.50"),
        (Metric("gap", "min", unit="m", headline="gap"), 0.0125, "gap 12.5 mm"),
        (Metric("laps", "sum", headline="laps"), 12345.6, "laps 12,346"),
    ],
)
def test_a_headline_reads_as_its_metric_says(metric, value, shown):
    assert headline(metric, value) == shown


def test_a_metric_without_a_headline_is_not_on_the_terminals_line(tmp_path):
    quiet = by_name([Metric("torque", "mean"), Metric("laps", "sum", headline="laps")])
    text = io.StringIO()
    console = Console(file=text, width=200)
    with RunLogger(tmp_path / "m.parquet", quiet, 1, console=console) as logger:
        (row,) = rows(1, 1)
        logger.add(row | {"episode/torque": 1.0, "episode/laps": 2.0})
    assert "laps 2" in text.getvalue() and "torque" not in text.getvalue()
