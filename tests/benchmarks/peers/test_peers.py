import pytest

from benchmarks.peers import venv
from benchmarks.peers.__main__ import COMPARISONS, FLOOR, PEERS, Comparison, compare
from benchmarks.peers.contestant import Contestant
from benchmarks.peers.ours import measures
from benchmarks.peers.worker import latency, rate


def test_every_comparison_names_a_peer_and_measures_of_ours():
    peers, ours = {peer.name for peer in PEERS}, measures()
    assert {c.peer for c in COMPARISONS} == peers
    assert {c.ours for c in COMPARISONS} | set(FLOOR) <= set(ours)


def test_keys_of_comparisons_are_unique():
    keys = [c.key for c in COMPARISONS]
    assert len(set(keys)) == len(keys)


class Fake(Contestant):
    """A contestant that gives one figure after the other, the first for warm-up."""

    def __init__(self, *values):
        self.values = iter((-1.0, *values))

    def measure(self, name, seconds):
        del name, seconds
        return next(self.values)


def row(faster_is_less, ours, theirs):
    comparison = Comparison("x", "a", "peer", "b", "a note", faster_is_less)
    rows = compare([comparison], Fake(*ours), Fake(*theirs), len(ours), 0.0)
    return {r.key: r.value for r in rows}


def test_a_ratio_of_rates_is_ours_over_theirs_without_the_warm_up():
    rows = row(False, ours=(4.0, 6.0, 9.0), theirs=(2.0, 2.0, 3.0))
    assert rows == {"ratio_x": 3.0, "ours_x": 6.0, "peer_x": 2.0}


def test_a_ratio_of_times_is_theirs_over_ours():
    assert row(True, ours=(4.0,), theirs=(2.0,))["ratio_x"] == 0.5


@pytest.fixture
def commands(monkeypatch, tmp_path):
    """What would be run to make an environment."""
    ran = []

    def run(command, name):
        del name
        ran.append(command)
        (tmp_path / "peer").mkdir(exist_ok=True)

    monkeypatch.setattr(venv, "folder", lambda: tmp_path)
    monkeypatch.setattr(venv, "_run", run)
    return ran


def test_an_environment_is_made_once_and_again_when_its_requirements_change(commands):
    venv.python("peer", ["a==1"])
    assert len(commands) == 2
    venv.python("peer", ["a==1"])
    assert len(commands) == 2
    venv.python("peer", ["a==2"])
    assert commands[-1][-1] == "a==2"


def test_a_peer_that_cannot_be_installed_is_named():
    with pytest.raises(venv.NotInstalled, match="peer could not be installed: no pip"):
        venv._run(["bash", "-c", "echo no pip >&2; exit 1"], "peer")


def test_a_rate_counts_units_and_a_latency_is_the_median_call():
    ticks = []
    assert rate(lambda: ticks.append(0), units=10)(0.01) > 0
    assert len(ticks) > 3  # three calls warm up
    assert 0 < latency(lambda: None)(0.01) < 1e4
