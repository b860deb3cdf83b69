"""The clock of everything that is shown, with a simulation that counts."""

import collections

import pytest

from rmp_mjx.viewer.player import LATE, Player, kept


class Counter:
    """Frames are numbers; ten of them in a second."""

    period = 0.1

    def __init__(self):
        self.history: collections.deque[int] = collections.deque(maxlen=300)
        self.count = 0

    def step(self) -> int:
        self.count += 1
        self.history.append(self.count)
        return self.count

    def restore(self, frame: int) -> None:
        while self.history[-1] > frame:
            self.history.pop()
        self.count = frame


@pytest.fixture
def player():
    return Player(Counter())


def play(player, seconds):
    for _ in range(round(seconds / 0.05)):
        player.advance(0.05)


def test_simulated_time_follows_the_wall_clock_at_the_chosen_speed(player):
    play(player, 2.0)
    # the first frame is made at once, and one step may be owed by rounding
    assert player.shown == pytest.approx(20, abs=1)
    player.speed = 0.5
    play(player, 2.0)
    assert player.shown == pytest.approx(30, abs=1)
    assert 0.4 < player.pace < 0.9  # on its way from 1 to 1/2


def test_what_is_very_late_is_lost(player):
    player.advance(50 * LATE)
    assert player.shown == 1


def test_paused_nothing_moves_but_by_single_steps(player):
    play(player, 1.0)
    player.paused, before = True, player.shown
    play(player, 1.0)
    assert player.shown == before
    player.once()
    assert player.shown == before + 1 and player.paused


def test_a_look_back_shows_the_past_and_the_present_goes_on_from_where_it_was(player):
    play(player, 3.0)
    now = player.simulation.count
    player.look_back(1.0)
    assert player.paused and player.advance(0.05) == now - 10
    player.look_back(100.0)
    assert player.advance(0.05) == 1  # the oldest frame
    player.paused = False
    player.advance(0.1)
    assert player.shown == now + 1


def test_going_on_from_the_past_forgets_what_came_after(player):
    play(player, 3.0)
    now = player.simulation.count
    player.look_back(1.0)
    player.go_on_from_there()
    assert player.simulation.count == now - 10 and not player.paused
    player.advance(0.1)
    assert player.shown == now - 9 == player.simulation.history[-1]


def test_something_is_shown_even_if_nothing_has_been_stepped(player):
    player.paused = True
    assert player.advance(0.1) == 1


def test_a_history_is_thirty_seconds_long():
    assert kept(0.05) == 600
