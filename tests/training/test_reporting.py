"""Logs, tables, plots and videos."""

import io

import numpy as np
import polars as pl
import pytest
from rich.console import Console

from rmp_mjx import runtime
from rmp_mjx.training import evaluate, report
from rmp_mjx.training.logging import RunLogger
from rmp_mjx.training.networks import zero_agent
from tests.training import toys


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
    with RunLogger(
        path / "m.parquet", path / "tb", total, first - 1, console
    ) as logger:
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
    report.plot_learning_curve(tmp_path / "m.parquet", tmp_path / "c.png", "title")
    assert (tmp_path / "c.png").read_bytes().startswith(b"\x89PNG")


def test_the_table_shows_intervals_beside_their_rates():
    text = io.StringIO()
    summary = {"success_rate": 0.5, "success_rate_ci95": [0.25, 0.75], "agent": "x"}
    Console(file=text, width=100).print(report.table(summary, "title"))
    assert "0.25 .. 0.75" in text.getvalue()


def film(tmp_path, render):
    text = io.StringIO()
    report.film(
        toys.Counter(),
        zero_agent(1),
        evaluate.jax.random.key(0),
        tmp_path / "v.mp4",
        Console(file=text, width=200),
        render,
    )
    return text.getvalue()


def test_a_video_is_written_where_rendering_works(tmp_path, monkeypatch):
    monkeypatch.setattr(runtime, "choose_gl", lambda: "egl")
    said = film(tmp_path, lambda env, s: [np.zeros((32, 32, 3), np.uint8)] * len(s))
    assert "video:" in said
    assert (tmp_path / "v.mp4").stat().st_size > 0


@pytest.mark.parametrize("gl", [None, "egl"])
def test_without_rendering_one_line_says_so(tmp_path, monkeypatch, gl):
    def render(env, states):
        raise RuntimeError("no\ncontext")

    monkeypatch.setattr(runtime, "choose_gl", lambda: gl)
    said = film(tmp_path, render)
    assert said.count("\n") == 1
    assert said.startswith("no video")
