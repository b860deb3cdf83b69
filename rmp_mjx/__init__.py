"""Safe, contact-rich manipulation: an RMP-tree with a learned impedance target."""

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rmp_mjx.facade import *  # noqa: F403

__version__ = "0.2.0"


def __getattr__(name: str) -> Any:
    """A module or a public name, loaded when it is asked for first.

    So `rmp_mjx.deploy`, which a robot's computer imports, needs no MuJoCo and no Flax.
    """
    if not name.startswith("_"):
        if importlib.util.find_spec(f"rmp_mjx.{name}"):
            return importlib.import_module(f"rmp_mjx.{name}")
        facade = importlib.import_module("rmp_mjx.facade")
        public = {k: v for k, v in vars(facade).items() if not k.startswith("_")}
        globals().update(public)
        if name in globals():
            return globals()[name]
    raise AttributeError(f"module 'rmp_mjx' has no attribute '{name}'")


def __dir__() -> list[str]:
    """The public names, whether they are loaded or not."""
    facade = importlib.import_module("rmp_mjx.facade")
    return sorted({*globals(), *vars(facade)})
