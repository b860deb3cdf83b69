"""The table of an evaluation."""

import io

from rich.console import Console

from envs import types
from envs.door import Door
from rmp_mjx.metric import SUCCESS, Metric, by_name
from rmp_mjx.training.evaluation import report

METRICS = by_name(
    [
        SUCCESS,
        Metric("clearance", "min", unit="m", table=("mean", "min")),
        Metric("laps", "sum", table=("mean",)),
        Metric("overflow", "max", fault="forces too low"),
    ]
)


def printed(columns):
    text = io.StringIO()
    Console(file=text, width=80).print(report.table(columns, "a title [N]", METRICS))
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
    said = printed({"toy": SUMMARY})
    rows = [line.strip("│ ") for line in said.splitlines() if "│" in line]
    assert rows[0].startswith("return, mean +- sd") and "12,346 +- 78.9" in rows[0]
    assert "50 [25, 75]" in said
    assert "clearance, min [mm]" in said and "12.3" in said
    assert "laps" in said and "a title [N]" in said
    assert "lost" not in said and "forces" not in said


def test_two_engines_stand_side_by_side_with_what_went_wrong_below():
    other = SUMMARY | {"success_rate": 0.25, "lost_episodes": 3}
    said = printed({"one": SUMMARY | {"overflow_max": 1.0}, "two": other})
    row = next(line for line in said.splitlines() if "success" in line)
    assert row.index("50 [") < row.index("25 [25, ")
    assert "episodes lost to a non-finite state: 3 (two)" in said
    assert "forces too low: 1 (one)" in said


def test_the_table_of_two_engines_fits_80_columns():
    """With every metric of a task, and the longest values that occur."""
    metrics = types.METRICS | by_name(Door.task_metrics)
    found = {"return_mean": -12345.6, "return_sd": 1234.5, "length_mean": 123.4}
    for metric in metrics.values():
        for statistic in metric.table:
            name = f"{metric.name}_{statistic}"
            found |= {name: 0.1234, f"{name}_ci95": [0.1234, 0.5678]}
    columns = {"mujoco, 2.5 ms, elliptic": found, "mjx, 5 ms, pyramidal": found}
    text = io.StringIO()
    console = Console(file=text, width=80)
    console.print(report.table(columns, "policy agent, door, rmp_vices", metrics))
    lines = text.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    rows = [line for line in lines if line.startswith("│")]
    assert all(line.strip("│ ")[0] not in "[0123456789" for line in rows)  # unbroken
    assert len(rows) == 3 + sum(len(metric.table) for metric in metrics.values())
