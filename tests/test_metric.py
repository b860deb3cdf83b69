"""Declarations of metrics: labels, units, columns, and what is refused."""

import dataclasses

import pytest

from rmp_mjx.metric import SUCCESS, Metric, by_name, number, of_fields, reductions


def test_people_read_metres_as_millimetres_and_shares_as_percent():
    metres, share, newtons, count = (
        Metric("x", "mean", unit=unit) for unit in ("m", "share", "N", "")
    )
    assert (metres.shown_unit, metres.factor) == ("mm", 1e3)
    assert (share.shown_unit, share.factor) == ("%", 100.0)
    assert (newtons.shown_unit, newtons.factor) == ("N", 1.0)
    assert (count.shown_unit, count.factor) == ("", 1.0)


def test_an_event_is_shown_by_its_rate_and_anything_else_by_its_episodes():
    assert Metric("crash", "sum", event=True).column == "per_1000_steps/crash"
    assert Metric("laps", "sum").column == "episode/laps"
    assert Metric("lap_time", "mean").label == "lap time"


def test_an_unknown_reduction_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"'median'.*sum, mean, max, min, last"):
        Metric("speed", "median")  # pyright: ignore[reportArgumentType]


def test_a_metric_has_one_declaration():
    laps = Metric("laps", "sum")
    assert by_name([SUCCESS, laps]) == {"success": SUCCESS, "laps": laps}
    assert reductions(by_name([SUCCESS, laps])) == {"success": "max", "laps": "sum"}
    with pytest.raises(ValueError, match="declared twice: laps"):
        by_name([laps, SUCCESS, laps])


def test_a_field_and_its_metric_have_the_same_name():
    def record(name):
        field = dataclasses.field(metadata={"metric": Metric("laps", "sum")})
        return dataclasses.make_dataclass("Record", [(name, int, field)])

    assert list(of_fields(record("laps"))) == ["laps"]
    with pytest.raises(ValueError, match="field 'rounds' declares metric 'laps'"):
        of_fields(record("rounds"))


def test_numbers_have_three_digits_and_large_ones_separators():
    shown = [number(x) for x in (0.12345, 999.4, 999.6, 12345.6)]
    assert shown == ["0.123", "999", "1,000", "12,346"]
