"""Tasks from outside: of installed packages, and classes named as `module:Class`.

A package offers tasks as entry points of the group `rmp_mjx.tasks`. `module:Class` is
imported when the user names it, on the command line or to `envs.task`. Files are data:
the record of a run or of a policy never makes this process import a module.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import sys
import traceback
import types
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from rmp_mjx.names import unknown

from .base import ArmEnv
from .options import Options
from .task import Task

GROUP = "rmp_mjx.tasks"
"""Entry points of this group are tasks."""

_found: dict[str, type[ArmEnv]] = {}
"""Tasks from outside that this process was asked for."""


def is_path(name: str) -> bool:
    """Whether a name is a `module:Class`."""
    return ":" in name


def check_recorded(name: str) -> None:
    """Refuse a task that a file names, if only an import could tell what it is.

    Raises:
        ValueError: It is a `module:Class` that the user has not named in this process.
    """
    if is_path(name) and name not in _found:
        raise ValueError(
            f"its task '{name}' is code of somebody's own, which is imported only if "
            f"you name it yourself: add --env {name}"
        )


def find(name: str, own: Sequence[str]) -> type[ArmEnv]:
    """The class of a task from outside; its options carry this name.

    Args:
        name: `module:Class`, or the name of an entry point. Modules are searched where
            Python searches, then in the working directory.
        own: Names of the tasks here, for the message.

    Raises:
        ValueError: There is none, its import fails, or it is no task.
    """
    if name not in _found:
        _found[name] = _imported(name) if is_path(name) else _installed(name, own)
    return _found[name]


def _imported(name: str) -> type[ArmEnv]:
    """The task `module:Class`."""
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)  # at the end: nothing that is installed is hidden
    return _load(name, name, f"env '{name}'")


def _installed(name: str, own: Sequence[str]) -> type[ArmEnv]:
    """The task of an installed package."""
    points = metadata.entry_points(group=GROUP)
    found = [point for point in points if point.name == name]
    if not found:
        valid = dict.fromkeys([*own, *sorted(points.names)])
        raise ValueError(
            f"{unknown('env', name, list(valid))} A class of your own is module:Class; "
            "a task of another package needs that package installed."
        )
    packages = [f"{p.dist.name} {p.dist.version}" if p.dist else "?" for p in found]
    if len(found) > 1:
        raise ValueError(f"env '{name}' is offered by {' and '.join(packages)}")
    return _load(name, found[0].value, f"env '{name}' of {packages[0]}")


def _load(name: str, target: str, what: str) -> type[ArmEnv]:
    """Import a target `module:Class`, check it and give it its name."""
    module, _, attribute = (part.strip() for part in target.partition(":"))
    if not all(map(str.isidentifier, [*module.split("."), attribute])):
        raise ValueError(f"{what}: '{target}' is no module:Class, as my_task:Reach is")
    try:
        place = importlib.import_module(module)
    except (Exception, SystemExit) as error:
        raise ValueError(f"{what}: {_why(module, error)}") from error
    if not hasattr(place, attribute):
        tasks = [key for key, value in vars(place).items() if _is_task(value)]
        raise ValueError(f"{what}: {unknown(f'class of {module}', attribute, tasks)}")
    kind = getattr(place, attribute)
    wrong = _wrong(kind)
    if wrong:
        raise ValueError(f"{what}: {wrong}")
    return _called(name, kind)


def _why(module: str, error: BaseException) -> str:
    """Why a module cannot be imported, and where it failed."""
    missing = error.name if isinstance(error, ModuleNotFoundError) else None
    if missing and f"{module}.".startswith(f"{missing}."):
        return (
            f"there is no module {missing}: install its package, or work in the folder "
            f"that holds {missing}.py"
        )
    steps = traceback.extract_tb(error.__traceback__)[1:]
    steps = [step for step in steps if "importlib" not in step.filename]
    where = f" ({Path(steps[-1].filename).name}:{steps[-1].lineno})" if steps else ""
    said = " ".join(str(error).split())
    return f"importing {module} failed: {type(error).__name__}: {said}{where}"


def _is_task(value: object) -> bool:
    return isinstance(value, type) and issubclass(value, ArmEnv) and value is not ArmEnv


def _wrong(kind: object) -> str | None:
    """Why something is no task, in words; None: it is one."""
    if not (isinstance(kind, type) and issubclass(kind, ArmEnv)):
        return "it is no subclass of ArmEnv"
    values = [
        name
        for name, hint in inspect.get_annotations(Task).items()
        if str(hint).startswith("ClassVar") and not hasattr(kind, name)
    ]
    missing = [*sorted(kind.__abstractmethods__), *values]
    if missing:
        return f"{kind.__name__} does not define {', '.join(missing)}"
    options = kind.Options
    if options is Options or not issubclass(options, Options):
        return f"{kind.__name__}.Options must be a subclass of Options"
    shown = options.__name__
    if "__dataclass_fields__" not in vars(options):
        return f"{shown} lacks its decorator @dataclasses.dataclass(frozen=True)"
    name = getattr(options, "env", None)
    fields = {field.name for field in dataclasses.fields(options)}
    if "env" in fields or not (isinstance(name, str) and name.strip()):
        return f'{shown} lacks the name of the task, env: ClassVar[str] = "reach"'
    try:
        options()
    except Exception as error:
        return f"{shown}() fails, but every option needs a good default: {error}"
    return None


def _called(name: str, kind: type[ArmEnv]) -> type[ArmEnv]:
    """The task, under the name that finds it again."""
    options = kind.Options
    if options.env == name:
        return kind
    named = dataclasses.make_dataclass(
        options.__name__,
        (),
        bases=(options,),
        frozen=True,
        namespace={"env": name, **_same(options)},
    )
    same = {"Options": named, **_same(kind)}
    return types.new_class(
        kind.__name__, (kind,), exec_body=lambda own: own.update(same)
    )


def _same(kind: type) -> dict[str, str | None]:
    """What a class says of itself."""
    return {"__doc__": kind.__doc__, "__module__": kind.__module__}
