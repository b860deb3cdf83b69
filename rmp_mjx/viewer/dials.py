"""A controller's parameters as dials: numbers by name, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import jax
import numpy as np

from rmp_mjx.control import RMPVICES, VICES, rmp_vices_literal
from rmp_mjx.control.cbf import FilteredVICES
from rmp_mjx.control.controller import ImpedanceController
from rmp_mjx.robot import Robot

Kind = TypeVar("Kind", bound=ImpedanceController)

Dials = dict[str, float]
"""Numbers by path in the controller, `leaves.collision.mu`."""

CONTROLLERS: dict[str, tuple[Any, str]] = {
    "rmp_vices": (RMPVICES, "from rmp_mjx import RMPVICES, Robot"),
    "vices": (VICES, "from rmp_mjx import VICES, Robot"),
    "vices_cbf": (
        FilteredVICES,
        "from rmp_mjx import Robot\nfrom rmp_mjx.control.cbf import FilteredVICES",
    ),
    "rmp_vices_literal": (
        rmp_vices_literal,
        "from rmp_mjx import Robot, rmp_vices_literal",
    ),
}
"""By name: what makes one for a robot, and the imports for that."""

_NO_DIALS = ("robot", "action_range", "period")


def make(name: str, robot: Robot, period: float) -> ImpedanceController:
    """A controller by its name, with its default parameters."""
    return CONTROLLERS[name][0](robot).replace(period=period)


def dials(controller: ImpedanceController) -> Dials:
    """Every parameter that is one number, by its path."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(controller)
    named = {_name(path): leaf for path, leaf in leaves}
    return {
        name: float(leaf)
        for name, leaf in named.items()
        if np.ndim(leaf) == 0 and name.split(".")[0] not in _NO_DIALS
    }


def named(controller: ImpedanceController, values: Any) -> dict[str, Any]:
    """Values in the order of the controller's dials, by their paths."""
    names = list(dials(controller))
    return {name: values[k] for k, name in enumerate(names)}


def turned(controller: Kind, values: Mapping[str, Any]) -> Kind:
    """The controller with other parameters; they may be traced."""

    def pick(path, leaf):
        return values.get(_name(path), leaf)

    return jax.tree_util.tree_map_with_path(pick, controller)


def as_python(name: str, robot: str, changed: Mapping[str, float]) -> str:
    """The lines of Python that make a controller with these parameters."""
    maker, imports = CONTROLLERS[name]
    lines = [imports, "", f"robot = Robot.load({robot!r})"]
    lines.append(f"controller = {maker.__name__}(robot)")
    if changed:
        tree: dict[str, Any] = {}
        for path, value in changed.items():
            *parents, last = path.split(".")
            inner = tree
            for part in parents:
                inner = inner.setdefault(part, {})
            inner[last] = value
        lines.append(f"controller = {_replaced('controller', tree)}")
    return "\n".join(lines) + "\n"


def _replaced(expression: str, tree: Mapping[str, Any]) -> str:
    parts = []
    for name, value in tree.items():
        nested = isinstance(value, Mapping)
        new = _replaced(f"{expression}.{name}", value) if nested else f"{value!r}"
        parts.append(f"{name}={new}")
    return f"{expression}.replace({', '.join(parts)})"


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path).lstrip(".")
