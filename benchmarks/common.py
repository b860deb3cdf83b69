"""What every benchmark shares: rows, timing, the machine, the JSON file."""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import rmp_mjx as rmp
from rmp_mjx import runtime
from rmp_mjx.control.contact import turning_by_contact
from rmp_mjx.control.tree import rmp_vices_tree
from rmp_mjx.robot.kinematics import arm_state, site_state
from rmp_mjx.training.learning import devices

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = (
    "rmp-mjx",
    "jax",
    "jaxlib",
    "mujoco",
    "mujoco-mjx",
    "warp-lang",
    "brax",
    "numpy",
)
DEFAULT_FLAGS_SUFFIX = "_default_flags"


@dataclass(frozen=True)
class Row:
    """One measured figure."""

    key: str
    """Stable name of the figure; runs are compared by it."""
    value: float
    """The figure."""
    unit: str
    """Its unit."""
    note: str
    """What a reader needs to know: sizes, method, spread."""


@dataclass(frozen=True)
class Timing:
    """Times of repeated calls of one compiled function."""

    compile_s: float
    """Time to trace, lower and compile, without the first call. [s]"""
    calls_s: np.ndarray
    """Wall time of each call, result ready. (n,) [s]"""

    @property
    def median(self) -> float:
        """Median call [s]."""
        return float(np.median(self.calls_s))

    @property
    def p99(self) -> float:
        """99th percentile of the calls [s]."""
        return float(np.percentile(self.calls_s, 99))

    @property
    def spread(self) -> str:
        """The number of calls and their quartiles relative to the median."""
        low, high = np.percentile(self.calls_s, [25, 75]) / self.median
        return f"{len(self.calls_s)} calls, quartiles {low:.2f}-{high:.2f} of median"


def measure(
    function: Callable[..., Any],
    *args: Any,
    seconds: float,
    max_calls: int = 2000,
    min_calls: int = 5,
) -> Timing:
    """Compile a function, then time its calls with the result awaited.

    Args:
        function: What to jit and time.
        *args: Its arguments, already on the device.
        seconds: Time to spend calling it. [s]
        max_calls: Stop after this many calls.
        min_calls: Make at least this many calls.
    """
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*args).compile()
    compile_s = time.perf_counter() - start
    return Timing(
        compile_s,
        time_calls(
            compiled, *args, seconds=seconds, max_calls=max_calls, min_calls=min_calls
        ),
    )


def time_calls(
    compiled: Callable[..., Any],
    *args: Any,
    seconds: float,
    max_calls: int = 2000,
    min_calls: int = 5,
) -> np.ndarray:
    """Time the calls of a compiled program with the result awaited, as `measure` does.

    Returns:
        Wall time of each call; of the first only, if it takes too long. (n,) [s]
    """
    start = time.perf_counter()
    jax.block_until_ready(compiled(*args))  # buffers, thread pools, page faults
    first = time.perf_counter() - start
    if first > seconds:  # hopelessly slow: one call says enough
        return np.array([first])
    calls: list[float] = []
    deadline = time.perf_counter() + seconds
    while len(calls) < min_calls or (
        len(calls) < max_calls and time.perf_counter() < deadline
    ):
        start = time.perf_counter()
        jax.block_until_ready(compiled(*args))
        calls.append(time.perf_counter() - start)
    return np.array(calls)


def measure_calls(
    function: Callable[..., Any], *args: Any, calls: int, warm_up: int = 100
) -> np.ndarray:
    """Time single calls as a user makes them, through ``jax.jit``'s dispatch.

    Returns:
        Wall time of each call, result ready. (calls,) [s]
    """
    jitted = jax.jit(function)
    for _ in range(warm_up):
        jax.block_until_ready(jitted(*args))
    times = np.empty(calls)
    for i in range(calls):
        start = time.perf_counter()
        jax.block_until_ready(jitted(*args))
        times[i] = time.perf_counter() - start
    return times


def on_all_devices(
    function: Callable[..., Any], size: int, in_axes: Sequence[int | None]
) -> Callable[..., Any]:
    """Vectorise a function; all devices of this process share the batch.

    Args:
        function: For one element.
        size: Elements of a batch.
        in_axes: 0 for each argument with an axis of elements, None for the others.
    """
    mesh = devices.local_mesh(size)
    batched = jax.vmap(function, in_axes=tuple(in_axes))
    return devices.per_device(batched, mesh, tuple(in_axes), 0)


def rows_with_default_flags(module: str, arguments: Sequence[str]) -> list[Row]:
    """Run a benchmark in a process with XLA's default flags; mark its rows.

    XLA reads its flags once per process, so this one cannot measure both.

    Args:
        module: The benchmark, as for ``python -m``.
        arguments: Its options; it must know ``--worker``, which prints its rows as
            one line of JSON instead of writing a file.
    """
    env = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments, "--worker"],
        cwd=ROOT,
        env=env,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise RuntimeError(f"{module} with default flags failed:\n{done.stderr}")
    rows = [Row(**row) for row in json.loads(done.stdout.splitlines()[-1])]
    return [
        Row(row.key + DEFAULT_FLAGS_SUFFIX, row.value, row.unit, row.note)
        for row in rows
    ]


def machine() -> dict[str, Any]:
    """Describe the machine and the software that a figure was measured with."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return {
        "cpu": _cpu_name(),
        "cores": runtime.usable_cores(),
        "memory_gib": _memory_gib(),
        "system": f"{platform.system()} {platform.release()}",
        "devices": sorted({device.device_kind for device in jax.devices()}),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "versions": versions,
        "git": _git_revision(),
    }


def write_json(path: Path, rows: Iterable[Row], **settings: Any) -> None:
    """Write rows with everything needed to repeat them.

    Args:
        path: The file; its folder is made.
        rows: The figures.
        **settings: Sizes and seeds of this run.
    """
    document = {
        "command": " ".join(["python", "-m", _module_name(), *sys.argv[1:]]),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine(),
        "settings": settings,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(as_json(document, [asdict(row) for row in rows]))


def other_rows(path: Path | None, parts: Collection[str]) -> list[Row]:
    """The rows that a file has of other parts (PART/...); none where it is not."""
    if path is None or not path.is_file():
        return []
    rows = (Row(**row) for row in json.loads(path.read_text())["rows"])
    return [row for row in rows if row.key.split("/")[0] not in parts]


def as_json(document: Mapping[str, Any], rows: Iterable[Mapping[str, Any]]) -> str:
    """A document and its rows as JSON, with one line for each row."""
    text = json.dumps({**document, "rows": []}, indent=2)
    lines = ",\n".join(f"    {json.dumps(row)}" for row in rows)
    return text.replace('"rows": []', f'"rows": [\n{lines}\n  ]') + "\n"


def show(rows: Iterable[Row], title: str) -> None:
    """Print rows as a table."""
    table = Table(title=title)
    table.add_column("key", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    table.add_column("note")
    for row in rows:
        table.add_row(row.key, f"{row.value:,.4g}", row.unit, row.note)
    Console(width=None if sys.stdout.isatty() else 140).print(table)


def _cpu_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _memory_gib() -> float:
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return round(pages / 2**30, 1)


def _git_revision() -> str | None:
    """Commit of the checkout, with ``+`` for local changes; None outside git."""
    try:
        found = subprocess.run(
            ["git", "describe", "--always", "--dirty=+", "--abbrev=12"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return found.stdout.strip()


def _module_name() -> str:
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    return spec.name.removesuffix(".__main__") if spec else Path(sys.argv[0]).stem


def markdown(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    rows = [head, ["---"] * len(head), *lines]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def insert(text: str, tables: Mapping[str, str]) -> str:
    """Replace the text between a page's `<!-- name -->` and `<!-- end -->`.

    Raises:
        ValueError: The page has no place for a table.
    """
    for name, body in tables.items():
        place = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        text, found = place.subn(lambda m, b=body: f"{m[1]}\n{b}\n\n{m[2]}", text)
        if not found:
            raise ValueError(f"the page has no '<!-- {name} -->' ... '<!-- end -->'")
    return text


class AutodiffRMPVICES(rmp.RMPVICES):
    """The definition of the controller, at time 0 of the set-point: without dither."""

    def __call__(self, q, qd, setpoint, obstacles, tau_ext=None, tau_last=None):
        """Torque for one state.

        The weights of this state are the closed form's. Compiled, nothing else of that
        is left.
        """
        out = super().__call__(q, qd, setpoint, obstacles, tau_ext, tau_last)
        q, qd = jnp.asarray(q), jnp.asarray(qd)
        weights, Mq, bias, turning = out.diagnostics, out.Mq, out.bias, 0.0
        w = self._by_contact(Mq, None if tau_ext is None else jnp.asarray(tau_ext))
        if w is not None:
            site = site_state(self.robot, arm_state(self.robot, q, qd))
            turning = turning_by_contact(site, Mq, w)
        tree = rmp_vices_tree(
            self.robot,
            self.leaves.weighted(setpoint.weights).braking(weights["stop_time"]),
            setpoint,
            obstacles,
            Mq,
            self.attractor_weight * weights["attractor_weight"],
            weights["orientation_weight"],
            turning,
        )
        root = rmp.evaluate(tree, q, qd, w)
        qdd, tau, limits = self.resolve(root, Mq, bias, qd, w, tau_last)
        return out.replace(
            tau=tau, qdd=qdd, f=root.f, M=root.M, diagnostics=weights | limits
        )
