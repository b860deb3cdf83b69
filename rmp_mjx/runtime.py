"""Per-process set-up for the entry points: XLA flags, compile cache, rendering.

A library must not touch the process it is imported into, so nothing here runs at
import. ``train.py``, ``eval.py``, the benchmarks and the test suite call
`configure` once, before JAX opens its backend.
"""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
import warnings
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import jax

# From jaxlib 0.10.0 until 0.11.0 XLA's CPU fusion recomputes a whole kinematic chain at
# every link: mjx.kinematics of a 7-joint arm goes from a few microseconds to several
# milliseconds or more per environment. Later releases neither need nor know the first
# flag, and XLA aborts the process on a flag that it does not know, so the flags are
# tied to exactly the releases they were tried on.
_CPU_FLAGS = (
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_cpu_experimental_ynn_fusion_type=",
)
_CPU_FLAGS_SINCE = (0, 10, 0)
_CPU_FLAGS_BEFORE = (0, 11, 1)

_GL_CONTEXT_MODULES = (
    "mujoco.rendering.classic.gl_context",
    "mujoco.gl_context",
)


@dataclass(frozen=True)
class Runtime:
    """What `configure` found or set for this process."""

    xla_flags: str
    """Value of ``XLA_FLAGS`` that the JAX backend starts with."""
    cache_dir: Path | None
    """Folder of the persistent compilation cache; None where it is off."""


def configure(
    *,
    cpu_flags: bool = True,
    split_cpu: bool = False,
    compile_cache: bool = True,
    cache_dir: str | os.PathLike[str] | None = None,
    async_dispatch: bool = True,
) -> Runtime:
    """Prepare this process; call it before the first JAX operation.

    Safe to call more than once. Settings that the user made (``XLA_FLAGS``,
    ``JAX_NUM_CPU_DEVICES``, ``JAX_COMPILATION_CACHE_DIR``, ``MUJOCO_GL``) always win.

    Args:
        cpu_flags: Append the CPU flags that this jaxlib release needs for fast
            kinematics. They do not affect a GPU.
        split_cpu: Make every core that this process may use a separate device, for
            programs that divide their work among devices (`jax.sharding`). XLA hardly
            spreads one program over several cores.
        compile_cache: Keep compiled programs on disk between runs.
        cache_dir: Folder of that cache. By default
            ``JAX_COMPILATION_CACHE_DIR``, then ``$XDG_CACHE_HOME/rmp_mjx/xla``,
            then ``~/.cache/rmp_mjx/xla``.
        async_dispatch: Whether XLA may compute in another thread while Python goes on.
            A robot's loop waits for every result: without it, it saves a change of
            threads, which takes long on a busy machine.

    Returns:
        The settings in force.

    Warns:
        RuntimeWarning: The JAX backend is already running, so XLA flags have no
            effect; or the cache folder cannot be written.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if cpu_flags:
        wanted = merge_flags(flags, cpu_xla_flags())
        if wanted != flags and _backend_is_running():
            warnings.warn(
                "rmp_mjx.runtime.configure() was called after JAX had started its "
                "backend: the CPU flags cannot take effect and the simulation may be "
                "hundreds of times slower. Call it before the first JAX operation.",
                RuntimeWarning,
                stacklevel=2,
            )
        elif wanted != flags:
            os.environ["XLA_FLAGS"] = flags = wanted
    if split_cpu:
        _split_cpu(flags)
    if not async_dispatch:
        jax.config.update("jax_cpu_enable_async_dispatch", False)
    folder = _enable_compile_cache(cache_dir) if compile_cache else None
    return Runtime(flags, folder)


def cpu_xla_flags(jaxlib_version: str | None = None) -> tuple[str, ...]:
    """CPU flags for a jaxlib version, the installed one by default."""
    text = jaxlib_version or metadata.version("jaxlib")
    release = tuple(int(part) for part in re.findall(r"\d+", text)[:3])
    return _CPU_FLAGS if _CPU_FLAGS_SINCE <= release < _CPU_FLAGS_BEFORE else ()


def merge_flags(current: str, extra: tuple[str, ...]) -> str:
    """Append flags to an ``XLA_FLAGS`` value, except those it already sets.

    Args:
        current: The user's value, space separated.
        extra: Flags of the form ``--name=value``.

    Returns:
        The merged value; ``current`` itself where there is nothing to add.
    """
    names = {flag.split("=", 1)[0] for flag in current.split()}
    missing = [flag for flag in extra if flag.split("=", 1)[0] not in names]
    return " ".join([current.strip(), *missing]).strip() if missing else current


def default_cache_dir() -> Path:
    """Folder of the compilation cache if neither caller nor user names one."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "rmp_mjx" / "xla"


def choose_gl() -> str | None:
    """Choose MuJoCo's rendering backend for this machine.

    Keeps ``MUJOCO_GL`` where it is set and MuJoCo's own choice where there is a
    display. Otherwise tries EGL, then OSMesa, and leaves the first that loads
    selected, also where MuJoCo is imported already.

    Returns:
        The name of the backend, or None where no headless one can be loaded.
    """
    chosen = os.environ.get("MUJOCO_GL")
    if chosen:
        return chosen
    if sys.platform != "linux" or os.environ.get("DISPLAY"):
        return "glfw"
    for name in ("egl", "osmesa"):
        if gl_loads(name):
            os.environ["MUJOCO_GL"] = name
            for module in _GL_CONTEXT_MODULES:
                if module in sys.modules:
                    importlib.reload(sys.modules[module])
            return name
    return None


def gl_loads(name: str) -> bool:
    """Whether a MuJoCo rendering backend can open a context on this machine.

    Tried in a separate process: a broken graphics stack may crash, and PyOpenGL keeps
    the first platform that it is imported with.
    """
    probe = subprocess.run(
        [sys.executable, "-c", "import mujoco; mujoco.GLContext(8, 8).free()"],
        env={**os.environ, "MUJOCO_GL": name, "PYOPENGL_PLATFORM": name},
        capture_output=True,
        timeout=60,
        check=False,
    )
    return probe.returncode == 0


def _split_cpu(flags: str) -> None:
    """One CPU device per core, unless the user has chosen otherwise."""
    forced = "--xla_force_host_platform_device_count" in flags
    chosen = jax.config.jax_num_cpu_devices >= 0  # pyright: ignore
    if not (forced or chosen or _backend_is_running()):
        jax.config.update("jax_num_cpu_devices", usable_cores())


def usable_cores() -> int:
    """Cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _enable_compile_cache(cache_dir: str | os.PathLike[str] | None) -> Path | None:
    """Point JAX at a persistent cache; None where the folder is not writable."""
    chosen = cache_dir or _user_cache_dir() or default_cache_dir()
    folder = Path(chosen).expanduser()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        writable = os.access(folder, os.W_OK | os.X_OK)
    except OSError:
        writable = False
    if not writable:
        warnings.warn(
            f"no compilation cache: {folder} cannot be written",
            RuntimeWarning,
            stacklevel=3,
        )
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    return folder


def _user_cache_dir() -> str | None:
    """Cache folder from ``JAX_COMPILATION_CACHE_DIR`` or an earlier jax.config."""
    return getattr(jax.config, "jax_compilation_cache_dir", None)


def _backend_is_running() -> bool:
    """Whether JAX has opened a backend (and so has read ``XLA_FLAGS``)."""
    # JAX has no public query for this; without one the answer is "not known to".
    bridge = sys.modules.get("jax._src.xla_bridge")
    query = getattr(bridge, "backends_are_initialized", None)
    return bool(query()) if query is not None else False
