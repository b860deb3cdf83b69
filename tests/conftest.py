"""Set-up shared by every test: XLA flags, a compile cache, checked annotations."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

ROOT = Path(__file__).resolve().parents[1]
# `envs` and the scripts live beside the package, not inside it.
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

_CACHE, _FLAGS = "JAX_COMPILATION_CACHE_DIR", "XLA_FLAGS"
QUICK = "--xla_backend_optimization_level=0"
"""Programs compile two to four times faster, and a test runs most of them once."""
CONTROLLER = ("rmp", "robot", "control")
"""Rooms of the controller, of the package and of the tests."""
CHECKED = [f"rmp_mjx.{name}" for name in (*CONTROLLER, "shapes", "obstacles", "vec")]
"""Modules whose annotations, shapes included, are checked while the tests run."""


def pytest_configure(config: pytest.Config) -> None:
    """Prepare JAX before any test module can start its backend.

    Workers and the commands that tests start inherit the cache folder, so each
    program is compiled once a run. Set JAX_COMPILATION_CACHE_DIR to keep it.
    """
    if _CACHE not in os.environ:
        os.environ[_CACHE] = tempfile.mkdtemp(prefix="rmp-mjx-test-xla-")
        config.stash[_own_cache] = Path(os.environ[_CACHE])

    flags = os.environ.get(_FLAGS, "")
    if "optimization_level" not in flags and config.option.markexpr == "not slow":
        os.environ[_FLAGS] = f"{flags} {QUICK}".strip()

    # From here on, what these modules take and return is held to its annotations.
    install_import_hook(CHECKED, "beartype.beartype")

    import jax

    from rmp_mjx import runtime

    # Scripts called in this process would split it among its cores, or not, depending
    # on whether an earlier test has started the backend.
    jax.config.update("jax_num_cpu_devices", 1)
    runtime.configure(cache_dir=os.environ[_CACHE])


def pytest_unconfigure(config: pytest.Config) -> None:
    if _own_cache in config.stash:
        shutil.rmtree(config.stash[_own_cache], ignore_errors=True)


_own_cache = pytest.StashKey[Path]()


@pytest.fixture(scope="session")
def root() -> Path:
    """The checkout."""
    return ROOT


@pytest.fixture(scope="session")
def robot():
    """The Jaco 2 as it ships."""
    from rmp_mjx import Robot

    return Robot.load()


@pytest.fixture(scope="session")
def bent():
    """An arm that is nowhere symmetric, with a slide and a base of its own place."""
    from rmp_mjx import Robot
    from tests.oracles import BENT

    return Robot.from_mjcf(BENT, site="tip", spacing=0.05)


@pytest.fixture(scope="module", autouse=True)
def ranks(request):
    """In the controller's rooms arrays of different ranks do not mix by accident."""
    import jax

    strict = request.path.parent.name in CONTROLLER
    with jax.numpy_rank_promotion("raise" if strict else "allow"):
        yield


@pytest.fixture
def x64():
    """Run the test in float64 (not globally: other tests stay in float32)."""
    import jax

    with jax.enable_x64(True):
        yield
