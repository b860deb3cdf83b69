"""A short name for everything that makes an arm what it is."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator
from typing import Any

import numpy as np

_LEFT_OUT = {"mjcf", "assets", "name"}
"""How the arm is written down; what the controllers use of it is in the arrays."""

_DECIMALS = 9
"""Decimals that count: the last bits differ between processors."""


def fingerprint(robot: Any) -> str:
    """Hash over the arm's arrays and the names of its joints, bodies and geoms.

    The same on every machine and in every process; neither the layout of the MJCF nor
    the folder that it came from matters. A field that is None does not count. Numbers
    are rounded to nine decimals.

    Args:
        robot: A `Robot` with concrete arrays.

    Returns:
        32 hex digits.
    """
    digest = hashlib.sha256()
    for line in _lines("robot", robot):
        digest.update(line.encode() + b"\n")
    return digest.hexdigest()[:32]


def _lines(name: str, value: Any) -> Iterator[str]:
    """Every array and static field as text, in the order of the fields' names."""
    if dataclasses.is_dataclass(value):
        for field in sorted(dataclasses.fields(value), key=lambda field: field.name):
            if field.name not in _LEFT_OUT:
                yield from _lines(f"{name}.{field.name}", getattr(value, field.name))
    elif isinstance(value, (tuple, str)):
        yield f"{name} {value!r}"
    elif value is not None:
        x = np.asarray(value, np.float64)
        rounded = np.round(x, _DECIMALS) + 0.0  # no negative zeros
        yield f"{name} {x.shape} {rounded.astype('<f8').tobytes().hex()}"
