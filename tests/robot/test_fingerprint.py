"""What a fingerprint is a hash of."""

import dataclasses
import hashlib
import struct
from typing import Any

import numpy as np

from rmp_mjx.robot.fingerprint import fingerprint


@dataclasses.dataclass
class Part:
    tags: Any
    numbers: Any
    name: str = "left out"


@dataclasses.dataclass
class Whole:
    part: Any
    length: Any
    none: None = None
    mjcf: str = "left out"
    assets: Any = ("left out",)


def test_it_is_that_of_the_fields_as_text_in_alphabetical_order():
    """Doubles of nine decimals in little endian, with their shape."""
    numbers = np.array([[0.125, -2.0], [-0.0, 1e-3]])
    whole = Whole(Part(("a", "b"), numbers), 0.5)

    def line(name, shape, *values):
        return (
            f"robot.{name} {shape} {struct.pack(f'<{len(values)}d', *values).hex()}\n"
        )

    lines = [
        line("length", (), 0.5),
        line("part.numbers", (2, 2), 0.125, -2.0, 0.0, 1e-3),
        "robot.part.tags ('a', 'b')\n",
    ]
    expected = hashlib.sha256("".join(lines).encode()).hexdigest()[:32]
    assert fingerprint(whole) == expected


def test_the_ninth_decimal_counts_and_the_tenth_does_not():
    def of(x):
        return fingerprint(Whole(Part((), ()), x))

    assert of(1.0 + 2e-9) != of(1.0) and of(1.0 + 2e-10) == of(1.0)
