"""The study of demonstrations: how it reads its curves."""

import numpy as np

from benchmarks.studies import demos

LOOKS = [
    (0, np.array([0.9, 0.2, 0.95, 0.0])),
    (100, np.array([0.92, 0.9, 0.8, 0.0])),
    (200, np.array([0.5, 0.9, 0.9, 0.9])),
    (300, np.array([0.5, 1.0, 0.98, 0.2])),
]


def test_a_seed_is_there_at_its_first_two_good_looks_in_a_row():
    assert demos.steps_to(LOOKS).tolist() == [0.0, 100.0, 200.0, np.inf]
    assert np.isinf(demos.steps_to(LOOKS[:1])).all()  # one look is no row


def test_the_rows_have_every_seed_and_the_whole_curve():
    arrived, first, last = demos.rows_of("demos", LOOKS)
    assert arrived.value == 3 and arrived.note.endswith("0, 100, 200, never")
    assert (first.key, first.value) == ("demos/success_at_start", 0.5125)
    assert "300: 0.50, 1.00, 0.98, 0.20" in last.note
