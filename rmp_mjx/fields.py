"""What no option can be, whether a command line, a file or a program gives it."""

import dataclasses
import math
import sys
from collections.abc import Sequence
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from rmp_mjx.names import unknown

LARGEST = 2**63 - 1
"""Greatest magnitude of a whole number."""


def arguments(args: Sequence[str] | None) -> list[str]:
    """The arguments of a command; an empty one is refused.

    A quoted shell variable that is not set is an empty argument. It must not count as
    an option that was left out.

    Args:
        args: Command line; None: this process's.

    Raises:
        ValueError: An argument is empty; the message names its option.
    """
    given = sys.argv[1:] if args is None else list(args)
    for before, argument in zip(["", *given], given, strict=False):
        option, equals, value = argument.partition("=")
        if equals and option.startswith("--") and not value.strip():
            raise ValueError(f"{option} is empty: give a value, or leave it out")
        if not argument.strip():
            name = before if before.startswith("--") else "an argument"
            raise ValueError(f"{name} is empty: give a value, or leave it out")
    return given


def check(options: Any, error: type[ValueError] = ValueError) -> None:
    """Check the fields of a dataclass against their annotations.

    A whole number may stand for a float. Numbers must be finite and have at most 64
    bits; texts must not be empty.

    Args:
        options: A dataclass of numbers, texts, names (`Literal`), tuples of these,
            other dataclasses, and None where the annotation allows it.
        error: Kind of error.

    Raises:
        ValueError: A field has no such value; the message names it.
    """
    hints = get_type_hints(type(options))
    for field in dataclasses.fields(options):
        wrong = _wrong(field.name, getattr(options, field.name), hints[field.name])
        if wrong:
            raise error(wrong)


def _wrong(name: str, value: Any, hint: Any) -> str | None:
    """Why a value is none of its annotation, in words; None: it is one."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        if value is None and NoneType in parts:
            return None
        return _wrong(name, value, next(part for part in parts if part is not NoneType))
    if origin is Literal:
        if value in parts:
            return None
        return unknown(name, str(value), [str(part) for part in parts])
    if origin is tuple:
        if not isinstance(value, tuple):
            return f"{name} must be several values, is {_shown(value)}"
        return next((w for v in value if (w := _wrong(name, v, parts[0]))), None)
    if hint in (int, float):
        return _wrong_number(name, value, hint)
    if not isinstance(hint, type):  # a type variable
        return None
    if not isinstance(value, hint):
        return f"{name} must be {_KINDS.get(hint, hint.__name__)}, is {_shown(value)}"
    if hint is str and not value.strip():
        return f"{name} is empty: give a value, or leave it out"
    return None


def _wrong_number(name: str, value: Any, kind: type) -> str | None:
    """Why a value is no number of a kind."""
    wanted = Integral if kind is int else Real
    if isinstance(value, bool) or not isinstance(value, wanted):
        return f"{name} must be {_KINDS[kind]}, is {_shown(value)}"
    if isinstance(value, Integral):
        if abs(int(value)) > LARGEST:
            return f"{name} has more than 64 bits: {_shown(value)}"
    elif not math.isfinite(value):
        return f"{name} must be finite, is {value}"
    return None


_KINDS = {
    int: "a whole number",
    float: "a number",
    str: "a text",
    bool: "true or false",
}
"""Kinds of values in words."""


def _shown(value: Any) -> str:
    """A value in a few words; a long one is cut."""
    if isinstance(value, Integral) and abs(int(value)) > LARGEST:
        return f"a number of {int(value).bit_length()} bits"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
