"""Interchangeable physics engines behind one small interface."""

from __future__ import annotations

import importlib.util

import jax
import mujoco

from rmp_mjx.sim.base import Contacts as Contacts
from rmp_mjx.sim.base import Physics as Physics
from rmp_mjx.sim.base import PhysicsError as PhysicsError
from rmp_mjx.sim.base import PhysicsState as PhysicsState
from rmp_mjx.sim.base import add_pairs as add_pairs
from rmp_mjx.sim.base import read_contacts as read_contacts
from rmp_mjx.sim.mjx import MjxPhysics
from rmp_mjx.sim.mujoco_c import MujocoPhysics
from rmp_mjx.sim.warp import WarpPhysics

ENGINES = {"mujoco": MujocoPhysics, "mjx": MjxPhysics, "warp": WarpPhysics}
"""Engines by name."""

NAMES = ("auto", *ENGINES)
"""What `load_physics` accepts: `auto` is `mujoco` on a CPU and `mjx` elsewhere."""


def load_physics(name: str, model: mujoco.MjModel) -> Physics:
    """The named engine with this model.

    Raises:
        PhysicsError: Unknown name, an engine that is not installed, or a model that it
            cannot simulate.
    """
    require(name)
    if name == "auto":
        name = "mujoco" if jax.default_backend() == "cpu" else "mjx"
    return ENGINES[name](model)


def require(name: str) -> None:
    """Check that an engine is available, before anything long starts.

    Raises:
        PhysicsError: Unknown name, or a package that is not installed.
    """
    if name not in NAMES:
        raise PhysicsError(f"unknown physics '{name}'; valid names: {', '.join(NAMES)}")
    if name == "warp" and importlib.util.find_spec("warp") is None:
        raise PhysicsError(
            "physics 'warp' needs the package warp-lang, which is not installed: "
            "pip install 'rmp-mjx[warp]'"
        )
