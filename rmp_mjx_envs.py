"""The tasks under the name that they install with. In a checkout they are `envs`."""

import importlib
import importlib.util
from types import ModuleType

from envs import *  # noqa: F403


def __getattr__(name: str) -> ModuleType:
    """A module of the tasks, for instance `train`."""
    if name.startswith("_") or importlib.util.find_spec(f"envs.{name}") is None:
        raise AttributeError(f"module 'rmp_mjx_envs' has no attribute '{name}'")
    return importlib.import_module(f"envs.{name}")
