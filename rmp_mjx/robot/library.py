"""Arms by name: those that ship, those of installed packages, and files."""

from __future__ import annotations

import importlib.util
import os
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

from rmp_mjx.names import unknown
from rmp_mjx.robot.errors import RobotError

SHIPPED: dict[str, dict[str, Any]] = {
    # The small damping of the Jaco's joints stands for losses that no controller knows.
    "jaco2": {"site": "grip", "compensate_passive": False},
    "panda": {"site": "ee"},
    "fr3": {"site": "ee"},
    "ur5e": {"site": "ee"},
    "iiwa14": {"site": "ee"},
    "planar3": {"site": "ee"},
}
"""Arms that ship, one file each in the folder `arms`, and their options."""

_ROBOSUITE = ("iiwa", "jaco", "kinova3", "panda", "sawyer", "ur5e", "xarm7")

_MENAGERIE: dict[str, tuple[str, str]] = {
    "flexiv_rizon4": ("flexiv_rizon4.xml", "attachment_site"),
    "franka_emika_panda": ("panda_nohand.xml", "attachment_site"),
    "franka_fr3": ("fr3.xml", "attachment_site"),
    "kinova_gen3": ("gen3.xml", "pinch_site"),
    "kuka_iiwa_14": ("iiwa14.xml", "attachment_site"),
    "ufactory_xarm7": ("xarm7_nohand.xml", "attachment_site"),
    "universal_robots_ur10e": ("ur10e.xml", "attachment_site"),
    "universal_robots_ur5e": ("ur5e.xml", "attachment_site"),
}
"""By folder of MuJoCo Menagerie: the arm's file and its end effector."""

FILES = (".xml", ".mjcf", ".urdf")
"""How a file of an arm may end."""


def robots() -> list[str]:
    """Names that `Robot.load` takes, besides paths of files.

    First the arms that ship with the library. Then `robosuite/NAME`, where robosuite is
    installed, and `menagerie/NAME`, where the environment variable MENAGERIE_ROOT is
    the folder of a copy of MuJoCo Menagerie.
    """
    return [*SHIPPED, *_installed()]


def find(name: str) -> tuple[str, dict[str, Any]]:
    """The file of an arm, and the options of `Robot.from_mjcf` that go with it.

    Args:
        name: One of `robots`, an MJCF or URDF file, or a file of parameters: `.toml`,
            with a name or path as `model` and options of `Robot.load`. Its paths are
            relative to its folder.

    Raises:
        RobotError: There is no such arm, or the file of parameters cannot be read.
    """
    if name in SHIPPED:
        path = resources.files("rmp_mjx.robot") / "arms" / f"{name}.xml"
        return str(path), SHIPPED[name]
    installed = _installed()
    if name in installed:
        return installed[name]
    if name.endswith(".toml"):
        return _parameters(Path(name))
    if name.endswith(FILES):
        return name, {}
    raise RobotError(
        f"{unknown('robot', name, [*SHIPPED, *installed])} Or give a path that ends in "
        f"{', '.join(FILES)} or .toml"
    )


def _installed() -> dict[str, tuple[str, dict[str, Any]]]:
    """Arms of packages: their files and options by name."""
    found: dict[str, tuple[str, dict[str, Any]]] = {}
    package = importlib.util.find_spec("robosuite")
    if package is not None and package.origin is not None:
        folder = Path(package.origin).parent / "models" / "assets" / "robots"
        for name in _ROBOSUITE:
            file = folder / name / "robot.xml"
            if file.is_file():
                found[f"robosuite/{name}"] = str(file), {"body": "right_hand"}
    root = os.environ.get("MENAGERIE_ROOT")
    for name, (file, site) in _MENAGERIE.items() if root else ():
        path = Path(str(root)) / name / file
        if path.is_file():
            found[f"menagerie/{name}"] = str(path), {"site": site}
    return found


def _parameters(path: Path) -> tuple[str, dict[str, Any]]:
    """What a file of parameters says, over what its model says."""
    try:
        given = tomllib.loads(path.read_text())
    except OSError as error:
        raise RobotError(f"no file of parameters at '{path}'") from error
    except tomllib.TOMLDecodeError as error:
        raise RobotError(f"'{path}' is not TOML: {error}") from error
    model = given.pop("model", None)
    if not isinstance(model, str):
        raise RobotError(f"'{path}' has no model: give a name of robots() or a path")
    if model.endswith((*FILES, ".toml")):
        model = str(path.parent / model)
    file, options = find(model)
    if "site" in given or "body" in given:  # one of them names the end effector
        options = {k: v for k, v in options.items() if k not in ("site", "body")}
    return file, options | given
