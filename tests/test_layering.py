"""The import law of CONTRIBUTING.md, and imports without side effects."""

import ast
import graphlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# Room -> the rooms that it may import (besides itself). Single modules at the top of
# the package are rooms of their own; `rmp_mjx` is the public facade.
GROUND = {"fields", "math", "metric", "names", "pytree", "refuse", "trees", "xla"}
BASE = GROUND | {"types", "vec"}
LAW = {
    "math": set(),
    "metric": {"names"},
    "fields": {"names"},
    "names": set(),
    "pytree": set(),
    "refuse": {"math"},
    "trees": set(),
    "xla": set(),
    "files": set(),
    "runtime": set(),
    "video": set(),
    "types": GROUND,
    "vec": GROUND,
    "rmp": GROUND | {"vec"},
    "shapes": GROUND | {"vec"},
    "obstacles": BASE | {"shapes"},
    "robot": BASE | {"rmp", "obstacles"},
    "control": BASE | {"rmp", "shapes", "obstacles", "robot"},
    "sim": BASE | {"obstacles", "robot", "runtime"},
    "training": GROUND | {"types", "runtime", "files", "video"},
    "check_robot": BASE
    | {"rmp", "shapes", "obstacles", "robot", "control", "sim", "runtime", "files"},
    "report": {"fields", "files", "training"},
    "deploy": BASE | {"files", "obstacles", "robot", "control"},
    "viewer": BASE
    | {"rmp", "shapes", "obstacles", "robot", "control", "runtime", "files", "video"},
    "commands": {"check_robot"},
    "facade": BASE | {"rmp", "obstacles", "robot", "control", "sim"},
    "rmp_mjx": {"facade"},
}
# The rooms inside `training`, each with those that it may import.
TRAINING = {
    "config": set(),
    "records": {"config"},
    "stats": set(),
    "demonstrations": {"config"},
    "lerobot": {"config", "demonstrations"},
    "learning": {"config"},
    "policy": {"config", "learning"},
    "runs": {"config", "records", "stats", "learning", "policy", "demonstrations"},
    "evaluation": {"config", "stats", "learning", "policy", "runs"},
    "brax": {"config", "learning", "policy", "runs"},
}
TOP_LEVEL = {"envs", "rmp_mjx_envs", "train", "eval", "export", "benchmarks", "tests"}
CONSOLE = {
    ("rmp_mjx.commands", "rmp_mjx_envs"),
    ("rmp_mjx.viewer.__main__", "rmp_mjx_envs"),
}
"""The imports against the law: a command starts a task."""
KNOW_MUJOCO = {"robot", "sim", "check_robot", "viewer"}
# where tasks and training meet
COMMAND_LINE = {
    f"envs.{name}"
    for name in [
        *("cli", "deployment", "episode_page", "eval", "export", "flags", "grid"),
        *("play", "replay", "results", "teleoperate", "teleoperation", "train"),
        *("view", "watch", "worst"),
    ]
}


def modules(package: str) -> list[Path]:
    return sorted(p for p in (ROOT / package).rglob("*.py"))


def dotted(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room(module: str) -> str:
    """`rmp_mjx.rmp.algebra` -> `rmp`; `rmp_mjx` -> `rmp_mjx`; `envs.x` -> `envs`."""
    head, *rest = module.split(".")
    return rest[0] if head == "rmp_mjx" and rest else head


def origin(node: ast.ImportFrom, path: Path) -> str:
    """The module that `from ... import` names; dots at its start are resolved."""
    if not node.level:
        return node.module or ""
    package = path.parents[node.level - 1].relative_to(ROOT).parts
    return ".".join([*package, *([node.module] if node.module else [])])


def imports(path: Path) -> Iterator[str]:
    """Dotted names of everything a file imports, at any depth of nesting."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = origin(node, path)
            # `from rmp_mjx import math` names a room; `from x import Y` does not.
            for alias in node.names:
                yield f"{base}.{alias.name}" if base == "rmp_mjx" else base


def edges(path: Path) -> set[str]:
    """Modules that a file imports, at any depth, for type checking alone included."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = origin(node, path)
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                found.add(inner if is_module(inner) else base)
    return {name for name in found if is_module(name)}


def is_module(name: str) -> bool:
    """Whether a dotted name is a module or package of this repository."""
    path = ROOT.joinpath(*name.split("."))
    return path.with_suffix(".py").exists() or (path / "__init__.py").exists()


def at_import(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes that run when a module is imported (function bodies do not)."""
    for child in ast.iter_child_nodes(tree):
        if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            for decorator in getattr(child, "decorator_list", []):
                yield decorator
                yield from at_import(decorator)
            continue
        if isinstance(child, ast.If) and "__main__" in ast.dump(child.test):
            continue
        yield child
        yield from at_import(child)


@pytest.mark.parametrize("path", modules("rmp_mjx"), ids=dotted)
def test_a_room_imports_only_the_rooms_below_it(path):
    here = room(dotted(path))
    assert here in LAW, f"new room {here!r}: give it a place in the import law"
    for name in imports(path):
        head = name.split(".")[0]
        if (dotted(path), name) not in CONSOLE:
            assert head not in TOP_LEVEL, f"{dotted(path)} imports {name}"
        if head == "mujoco":
            assert here in KNOW_MUJOCO, f"{dotted(path)} imports {name}"
        if head == "rmp_mjx" and here != room(name) and room(name) in LAW:
            assert room(name) in LAW[here], f"{dotted(path)} imports {name}"


@pytest.mark.parametrize("path", modules("rmp_mjx/training"), ids=dotted)
def test_the_rooms_of_training_stand_on_each_other(path):
    _, _, here, *_ = [*dotted(path).split("."), None]
    for name in edges(path):
        _, _, other, *_ = [*name.split("."), None, None]
        if here and other and name.startswith("rmp_mjx.training.") and other != here:
            assert here in TRAINING, f"new room {here!r}: give it a place"
            assert other in TRAINING[here], f"{dotted(path)} imports {name}"


def test_no_modules_import_each_other_in_a_circle():
    graph = {dotted(p): edges(p) for p in modules("rmp_mjx") + modules("envs")}
    assert "rmp_mjx.training.runs.run_folder" in graph["rmp_mjx.training.runs.watch"]
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


@pytest.mark.parametrize("path", modules("envs"), ids=dotted)
def test_environments_know_nothing_of_training(path):
    if dotted(path) in COMMAND_LINE:
        pytest.skip("the command line joins tasks and training")
    for name in imports(path):
        assert room(name) != "training", f"{dotted(path)} imports {name}"
        assert name.split(".")[0] not in TOP_LEVEL - {"envs"}


@pytest.mark.parametrize("path", modules("rmp_mjx") + modules("envs"), ids=dotted)
def test_tasks_import_each_other_relatively_and_the_library_does_not(path):
    """Where they are installed, the tasks have another name than in a checkout."""
    inside = dotted(path).startswith("envs")
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            head = origin(node, path).split(".")[0]
            assert bool(node.level) == (inside and head == "envs"), ast.unparse(node)
        elif isinstance(node, ast.Import):
            assert "envs" not in [alias.name.split(".")[0] for alias in node.names]


@pytest.mark.parametrize("path", modules("rmp_mjx") + modules("envs"), ids=dotted)
def test_importing_a_module_does_nothing_but_define(path):
    for node in at_import(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute):
            text = ast.unparse(node)
            assert not text.startswith("os.environ"), f"{text} at import"
            assert not text.startswith("jax.config"), f"{text} at import"
        if isinstance(node, ast.Call):
            text = ast.unparse(node.func)
            assert text != "print", f"{dotted(path)} prints at import"
            assert not text.startswith(("jnp.", "jax.numpy.", "jax.random.")), (
                f"{dotted(path)} line {node.lineno}: {text}() makes an array at import"
            )


def test_importing_everything_starts_no_backend_and_sets_nothing():
    code = """
import contextlib, os, pkgutil, importlib
import jax, mujoco, flax, optax, polars, brax.training.acme.running_statistics
import orbax.checkpoint, matplotlib, mediapy, tensorboardX, rich, tyro
from mujoco import mjx
with contextlib.suppress(ModuleNotFoundError):
    import gymnasium
with contextlib.suppress(ModuleNotFoundError):
    import viser, mjviser.conversions
before, settings = dict(os.environ), dict(jax.config.values)
import rmp_mjx, envs
for package in (rmp_mjx, envs):
    for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        try:
            importlib.import_module(found.name)
        except ModuleNotFoundError as missing:  # of an extra
            extra = "gymnasium" if found.name == "envs.gym" else "viser"
            assert missing.name == extra, missing
assert dict(os.environ) == before, set(os.environ.items()) ^ set(before.items())
changed = {k for k, v in jax.config.values.items() if settings.get(k, v) != v}
assert not changed, changed
from jax._src import xla_bridge
assert not xla_bridge.backends_are_initialized(), "a backend was started"
print("quiet")
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().splitlines()[-1] == "quiet"
