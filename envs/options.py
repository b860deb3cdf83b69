"""What a task can be asked for: one dataclass, checked before anything is built."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from envs.placement import LAYOUTS
from rmp_mjx.control import RMPVICES, VICES, rmp_vices_literal
from rmp_mjx.control.cbf import FilteredVICES
from rmp_mjx.control.osc import OSC
from rmp_mjx.names import unknown
from rmp_mjx.robot import Robot

CONTROLLERS = {
    "rmp_vices": RMPVICES,
    "vices": VICES,
    "rmp_vices_literal": rmp_vices_literal,
    "osc": OSC,
    "vices_cbf": FilteredVICES,
}
"""Controllers by name: each makes one for a robot."""

CTRL_DT = 0.05
"""Seconds per policy step."""

CONES = ("pyramidal", "elliptic")
"""MuJoCo's friction cones."""

_AT_LEAST_ZERO = (
    "obstacles",
    "obstacle_speed",
    "obstacle_noise",
    "obstacle_delay",
    "start_noise",
)


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of every task; a task adds its own in a subclass."""

    controller: Any = "rmp_vices"
    """A name in `CONTROLLERS`, or a controller object."""
    physics: str = "auto"
    """`auto`, `mujoco` (C engine), `mjx` or `warp` (MuJoCo Warp)."""
    armature: str = "physical"
    """Rotor inertias of the Jaco 2: `physical` or `robosuite`."""
    robot: Robot | None = None
    """An arm of your own instead; it starts at its `q_home`."""
    sim_dt: float = 0.005
    """Physics and control timestep [s]; must divide 0.05 s."""
    cone: str = "pyramidal"
    """Friction cone: `pyramidal` or `elliptic`."""
    obstacles: int = 0
    """Random spheres, new in every episode."""
    sphere_radius: float = 0.05
    """Their radius [m]."""
    layout: str = "far"
    """Their clearances at the start, `far` or `close`."""
    obstacle_speed: float = 0.0
    """Speed of the spheres, each in a random direction [m/s]."""
    obstacle_noise: float = 0.0
    """Standard deviation of the sphere positions that the controller is told, drawn
    anew at every policy step [m]."""
    obstacle_delay: float = 0.0
    """Age of the sphere positions that the controller is told [s]."""
    event_penalty: float = 50.0
    """Cost of a collision or joint-limit event."""
    terminate_on_event: bool = True
    """Whether such an event ends the episode."""
    terminate_on_success: bool = False
    """Whether solving the task ends the episode."""
    episode_length: int = 1024
    """Policy steps until the time limit, which the caller enforces."""
    start_noise: float = 0.02
    """Standard deviation of the start configuration [rad]."""

    def __post_init__(self):
        """Check the values.

        Raises:
            ValueError: An option has no such value; the message lists the valid ones.
        """
        if isinstance(self.controller, str):
            self._check("controller", tuple(CONTROLLERS))
        substeps(self.sim_dt)
        self._check("cone", CONES)
        self._check("layout", tuple(LAYOUTS))
        for name in _AT_LEAST_ZERO:
            if not getattr(self, name) >= 0:
                raise ValueError(
                    f"{name} must be at least 0, got {getattr(self, name)}"
                )
        if self.episode_length < 1:
            raise ValueError(
                f"episode_length must be at least 1, got {self.episode_length}"
            )
        if not self.sphere_radius > 0:
            raise ValueError(
                f"sphere_radius must be positive, got {self.sphere_radius}"
            )

    def _check(self, name: str, valid: tuple[str, ...]) -> None:
        if getattr(self, name) not in valid:
            raise ValueError(unknown(name, getattr(self, name), valid))


def substeps(sim_dt: float) -> int:
    """Physics steps per policy step.

    Raises:
        ValueError: The timestep is not positive or does not divide the policy step.
    """
    if not (np.isfinite(sim_dt) and 0 < sim_dt <= CTRL_DT):
        raise ValueError(f"sim_dt must be in (0, {CTRL_DT}] s, got {sim_dt}")
    n = round(CTRL_DT / sim_dt)
    if abs(n * sim_dt - CTRL_DT) > 1e-9:
        raise ValueError(
            f"sim_dt={sim_dt} s does not divide the policy step of {CTRL_DT} s"
        )
    return n


def make(kind: type[Options], task: str, options: Mapping[str, Any]) -> Options:
    """A task's options from keyword arguments.

    Raises:
        ValueError: Unknown option or value; the message lists the valid ones.
    """
    valid = [field.name for field in dataclasses.fields(kind)]
    for name in options:
        if name not in valid:
            raise ValueError(unknown(f"option of '{task}'", name, valid))
    return kind(**options)


def parse(kind: type[Options], task: str, texts: Iterable[str]) -> dict[str, Any]:
    """Option values from texts like `layout=close`, each of its option's type.

    Raises:
        ValueError: Not of the form NAME=VALUE, an unknown option, or not its type.
    """
    defaults = {
        field.name: field.default
        for field in dataclasses.fields(kind)
        if isinstance(field.default, (bool, int, float, str))
    }
    values = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ValueError(f"an option reads NAME=VALUE, got '{text}'")
        if name not in defaults:
            raise ValueError(unknown(f"option of '{task}'", name, tuple(defaults)))
        values[name] = _convert(name, value, type(defaults[name]))
    return values


def _convert(name: str, text: str, kind: type) -> Any:
    if kind is bool:
        if text.lower() not in ("true", "false"):
            raise ValueError(f"{name} must be true or false, got '{text}'")
        return text.lower() == "true"
    try:
        return kind(text)
    except ValueError as error:
        raise ValueError(f"{name} must be a {kind.__name__}, got '{text}'") from error
