"""Refusing numbers that cannot be meant, as far as they are known.

Traced values pass: what a compiled controller does with them is in docs/fail_safe.md.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from rmp_mjx.math import LOOSE

Test = Callable[[np.ndarray], Any]
"""From numbers to whether they are good, for all at once or one by one."""


def refuse_unless(good: Test, what: str, values: Any, wanted: str) -> None:
    """Refuse numbers that are known and not good.

    Args:
        good: What is asked of them.
        what: Their name.
        values: An array, a number or a list of them; None passes.
        wanted: What is asked, in words after "must be".

    Raises:
        ValueError: The message has the name, what is asked, and what was given.
    """
    known = known_numbers(values)
    if known is not None and not np.all(good(known)):
        raise ValueError(f"{what} must be {wanted}, got {known.tolist()}")


def known_numbers(values: Any) -> np.ndarray | None:
    """Values as an array; None if one is traced, or none at all."""
    numbers = (bool, int, float, np.ndarray, np.generic, jax.Array)
    leaves = jax.tree.leaves(values)
    traced = any(isinstance(x, Tracer) or not isinstance(x, numbers) for x in leaves)
    return None if traced or values is None else np.asarray(values, float)


def positive(x: np.ndarray) -> np.ndarray:
    """Which numbers are finite and above zero."""
    return np.isfinite(x) & (x > 0.0)


def not_negative(x: np.ndarray) -> np.ndarray:
    """Which numbers are finite and not below zero."""
    return np.isfinite(x) & (x >= 0.0)


def directions(x: np.ndarray) -> np.ndarray:
    """Which vectors (..., n) are finite and have a direction."""
    length = np.linalg.norm(x, axis=-1)
    return np.isfinite(length) & (length > 1e-9)


def rotations(R: np.ndarray) -> np.ndarray:
    """Which matrices (..., 3, 3) are rotations, up to rounding in any precision."""
    square = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)) <= LOOSE
    return np.all(square, axis=(-1, -2)) & (np.linalg.det(R) > 0.0)


def refuse_crossed(lower: Any, upper: Any, names: tuple[str, str]) -> None:
    """Refuse limits of which a lower one is above the upper one, or not a number.

    Raises:
        ValueError: The message has both names and what was given.
    """
    low, high = known_numbers(lower), known_numbers(upper)
    if low is not None and high is not None and not np.all(low <= high):
        raise ValueError(
            f"{names[0]} must be at most {names[1]}, "
            f"got {low.tolist()} and {high.tolist()}"
        )
