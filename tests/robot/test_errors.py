"""Numbers that are given with a file, and where warnings point."""

import re
import warnings

import numpy as np
import pytest

from rmp_mjx import RobotError, RobotWarning
from rmp_mjx.robot.errors import positive, vector, warn


@pytest.mark.parametrize("given", [[1.0], [1.0, 2.0, 3.0], [[1.0, 2.0]], 1.0])
def test_a_vector_has_its_length(given):
    message = f"x must be 2 finite numbers, got {given}"
    with pytest.raises(RobotError, match=re.escape(message)):
        vector("x", np.array(given), 2)
    np.testing.assert_array_equal(vector("x", (1, 2), 2), [1.0, 2.0])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_vector_is_finite(bad):
    with pytest.raises(RobotError, match="x must be 2 finite numbers"):
        vector("x", [0.0, bad], 2)


@pytest.mark.parametrize("bad", [0.0, -1e-9, -1.0, -3.0])
def test_positive_numbers_are_above_zero(bad):
    with pytest.raises(RobotError, match="x must be positive, got"):
        positive("x", [1.0, bad], 2)
    np.testing.assert_array_equal(positive("x", [1e-9, 2.0], 2), [1e-9, 2.0])
    assert positive("x", [], 0).shape == (0,)


def test_a_warning_points_at_the_callers_line():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn("said")
        exec(compile("\n\nwarn('again')", "own.py", "exec"), {"warn": warn} | NAMES)
    first, second = caught
    assert first.category is RobotWarning and str(first.message) == "said"
    assert first.filename == __file__
    assert (second.filename, second.lineno) == ("own.py", 3)


NAMES = {"__name__": "own"}
