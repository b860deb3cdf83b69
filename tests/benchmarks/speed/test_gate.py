import json
import sys

import pytest

from benchmarks.speed import gate
from benchmarks.speed.gate import (
    COUNTS,
    HIGHER,
    LOWER,
    RATIOS,
    SLOW_RATIOS,
    Check,
    judge,
)

SPEED = Check("speed", HIGHER, 1.5, "a speed")
SIZE = Check("size", LOWER, 1.1, "a size", compiled=True)
BASELINE = {"speed": 3.0, "size": 100.0}


def statuses(now, same_jax=True):
    verdicts = judge([SPEED, SIZE], BASELINE, now, same_jax)
    return {v.check.key: v.status for v in verdicts}


def test_figures_within_their_factor_pass():
    assert statuses({"speed": 2.01, "size": 109.0}) == {"speed": "ok", "size": "ok"}


def test_a_slower_or_larger_figure_beyond_its_factor_is_worse():
    now = {"speed": 1.99, "size": 111.0}
    assert statuses(now) == {"speed": "WORSE", "size": "WORSE"}


def test_a_figure_that_is_no_number_is_worse():
    assert statuses({"speed": float("nan")}) == {"speed": "WORSE"}


def test_a_gain_beyond_the_factor_is_shown():
    assert statuses({"speed": 4.6, "size": 50.0}) == {
        "speed": "better",
        "size": "better",
    }


def test_counts_of_programs_are_not_compared_between_versions_of_jax():
    now = {"speed": 1.0, "size": 1000.0}
    assert statuses(now, same_jax=False) == {"speed": "WORSE", "size": "other jax"}


def test_a_figure_without_a_baseline_is_new():
    assert judge([SPEED], {}, {"speed": 1.0}, True)[0].status == "new"


@pytest.fixture
def run(monkeypatch, capsys):
    """The gate with figures made up instead of measured; its exit code and output."""

    def run(**doctored):
        document = json.loads(gate.BASELINE.read_text())
        figures = {row["key"]: row["value"] for row in document["rows"]}
        counts = {check.key for check in COUNTS}
        now = {key: value * doctored.pop(key, 1.0) for key, value in figures.items()}
        assert not doctored, "no such row"
        monkeypatch.setattr(
            gate, "count", lambda: {k: v for k, v in now.items() if k in counts}
        )
        monkeypatch.setattr(
            gate,
            "measure_ratios",
            lambda *_: {k: v for k, v in now.items() if k not in counts},
        )
        version = document["machine"]["versions"]["jax"]
        monkeypatch.setattr(gate.jax, "__version__", version)
        code = 0
        try:
            gate.main([])
        except SystemExit as stop:
            code = stop.code
        return code, capsys.readouterr().out

    return run


def test_the_committed_baseline_passes_against_itself(run):
    code, text = run()
    assert code == 0
    assert "WORSE" not in text


def test_the_committed_baseline_has_every_figure():
    document = json.loads(gate.BASELINE.read_text())
    checks = [ratio.check for ratio in (*RATIOS, *SLOW_RATIOS)] + list(COUNTS)
    assert {row["key"] for row in document["rows"]} == {c.key for c in checks}


@pytest.mark.parametrize(
    "check",
    [*(ratio.check for ratio in (*RATIOS, *SLOW_RATIOS)), *COUNTS],
    ids=lambda check: check.key,
)
def test_a_doctored_row_fails_the_gate_and_is_named(run, check):
    worse = 1.01 * check.factor
    code, text = run(**{check.key: 1 / worse if check.better == HIGHER else worse})
    assert code == 1
    assert f"worse than allowed: {check.key}" in text


def test_without_a_baseline_the_gate_says_how_to_make_one(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        gate.main(["--baseline", str(tmp_path / "none.json")])
    assert stop.value.code == 2
    assert "--update" in capsys.readouterr().err


class Fake:
    """A contestant whose speeds are known."""

    speeds = {"evals_rmp_vices": 4.0, "evals_autodiff": 2.0}  # noqa: RUF012

    def __init__(self, module, arguments=()):
        self.factor = 0.5 if arguments else 1.0
        self.closed = False

    def measure(self, name, seconds):
        return self.factor * self.speeds[name]

    def close(self):
        self.closed = True


def test_a_ratio_is_above_over_below_and_flags_go_with_above(monkeypatch):
    monkeypatch.setattr(gate, "Contestant", Fake)
    by_key = {ratio.check.key: ratio for ratio in RATIOS}
    ratios = [
        by_key[k] for k in ("closed_form_over_autodiff", "default_over_tuned_flags")
    ]
    found = gate.measure_ratios(ratios, rounds=2, seconds=0.0)
    assert found == {"closed_form_over_autodiff": 2.0, "default_over_tuned_flags": 0.5}


def test_operations_are_counted_in_the_programs_text():
    text = "module {\n  %0 = add %a, %b\n  %1 = mul %0, %0\n  return %1\n}"
    assert gate.operations(text) == 2


def test_the_gate_runs_our_contestant_with_this_interpreter():
    from benchmarks.peers.contestant import Contestant

    contestant = Contestant("tests.benchmarks.peers.echo_contestant", ["7.5"])
    try:
        assert contestant.versions.keys() == {"numpy"}
        assert contestant.measure("echo", 2.0) == 15.0
    finally:
        contestant.close()
    assert contestant.process.returncode == 0
    assert sys.executable in str(contestant.process.args)


def test_a_failing_contestant_says_why():
    from benchmarks.peers.contestant import Contestant, ContestantError

    contestant = Contestant("tests.benchmarks.peers.echo_contestant", ["7.5"])
    with pytest.raises(ContestantError, match="no such measure"):
        contestant.measure("broken", 1.0)
    contestant.close()
