"""The folder of a run: what it contains, and who may write into it."""

import json
import os
import platform
import shutil
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path
from typing import IO, Any

import jax

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

from rmp_mjx.files import write_text
from rmp_mjx.training.runs import identity, trackers
from rmp_mjx.training.config import (
    ConfigError,
    TrainConfig,
    differing_fields,
    read_record,
    save_config,
)

CONFIG = "config.json"
VERSIONS = "versions.json"
METRICS = "metrics.parquet"
CHECKPOINTS = "checkpoints"
POLICY = "policy.safetensors"
TENSORBOARD = "tensorboard"
NONFINITE = "nonfinite"
TRACKED = ("wandb_run", "mlflow_run", "wandb")
CURVE = "learning_curve.png"
DETAILS = "training_details.png"
SEEDS = "seeds"
SEED_CURVES = f"{SEEDS}/curves.parquet"
EVALUATION = "eval.json"
EPISODES = "episodes.parquet"
FORCES = "contact_forces.png"
CLEARANCES = "clearances.png"
INSTANCE = "instance.png"
STORYBOARD = "storyboard.png"
VIDEO = "video.mp4"
LOCK = "lock"
PACKAGES = (
    "jax",
    "jaxlib",
    "brax",
    "flax",
    "optax",
    "mujoco",
    "mujoco-mjx",
    "numpy",
    "rmp-mjx",
)
RESULTS = (
    CONFIG,
    VERSIONS,
    METRICS,
    CHECKPOINTS,
    POLICY,
    TENSORBOARD,
    NONFINITE,
    *TRACKED,
    CURVE,
    DETAILS,
    SEEDS,
    EVALUATION,
    EPISODES,
    FORCES,
    CLEARANCES,
    INSTANCE,
    STORYBOARD,
    VIDEO,
)


def default_run_dir(config: TrainConfig) -> Path:
    """A new folder name under runs/, from the task, the seed and the time."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    task = config.task.title.replace(", ", "-")
    return Path("runs") / f"{task}-seed{config.ppo.seed}-{stamp}"


def seed_folders(config: TrainConfig, folder: Path) -> list[Path]:
    """Where each seed's own results go: the run's folder itself where it has one."""
    ppo = config.ppo
    if ppo.num_seeds == 1:
        return [folder]
    numbers = range(ppo.seed, ppo.seed + ppo.num_seeds)
    return [folder / SEEDS / str(number) for number in numbers]


def open_run(config: TrainConfig) -> tuple[Path, IO[str]]:
    """Prepare and lock the folder of a run; starts no JAX backend.

    Args:
        config: Configuration.

    Returns:
        The folder, and its lock: the lock lasts as long as the file stays open.

    Raises:
        ConfigError: The folder has results already, belongs to another
            configuration, cannot be written, or another process uses it.
    """
    trackers.check(config)
    run = config.run
    if run.resume:
        folder = Path(run.resume)
        different = differing_fields(read_record(folder / CONFIG), config)
        if different:
            changes = ", ".join(f"{k}: {a} -> {b}" for k, (a, b) in different.items())
            raise ConfigError(f"a resumed run keeps its configuration ({changes})")
        newer = changed_software(folder)
        if newer and not run.allow_changes:
            raise ConfigError(
                f"not what this run was trained with: {', '.join(newer)}; "
                "--allow_changes resumes it all the same, though not exactly"
            )
    else:
        folder = Path(run.run_dir) if run.run_dir else default_run_dir(config)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = _lock(folder)
    except OSError as error:
        raise ConfigError(f"cannot write to {folder}: {error.strerror}") from error
    if not run.resume:
        others = sorted(p.name for p in folder.iterdir() if p.name != LOCK)
        if others and not run.overwrite:
            raise ConfigError(
                f"{folder} is not empty: --resume {folder} continues that run, "
                "--overwrite deletes its results"
            )
        for name in RESULTS:
            path = folder / name
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    return folder, lock


def _lock(folder: Path) -> IO[str]:
    """Take the folder's lock; the system releases it when the process ends."""
    if fcntl is None:
        raise ConfigError(
            "training needs Linux or macOS: it locks a run's folder with flock, which "
            f"{platform.system()} does not have"
        )
    lock = (folder / LOCK).open("a+")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        lock.seek(0)
        owner = lock.read().strip() or "another process"
        lock.close()
        raise ConfigError(f"{folder} is in use by {owner}") from error
    lock.truncate(0)
    lock.write(f"process {os.getpid()} on {platform.node()}\n")
    lock.flush()
    return lock


def describe(folder: Path, config: TrainConfig, env: Any) -> list[str]:
    """Write the configuration, the environment's identity and the versions of a run.

    A resumed run adds its versions to those that it was started with.

    Returns:
        What has changed since the run was last continued: a resumed run is
        bit-identical to an uninterrupted one only where this is empty.
    """
    save_config(config, folder / CONFIG, **{identity.KEY: identity.of(env)})
    history, now = _history(folder), versions()
    write_text(folder / VERSIONS, json.dumps([*history, now], indent=2) + "\n")
    return changes_since(history, now)


def _history(folder: Path) -> list[dict[str, str]]:
    """Versions that a run was started and continued with."""
    path = folder / VERSIONS
    try:
        return json.loads(path.read_text()) if path.exists() else []
    except json.JSONDecodeError as error:
        raise ConfigError(f"{path} is damaged ({error}): delete it to go on") from error


def changed_software(folder: Path) -> list[str]:
    """What is not as it was when a run was last continued; starts no JAX backend."""
    return changes_since(_history(folder), software())


def trained_with(folder: Path) -> dict[str, str]:
    """Packages, code and device that a run was last continued with."""
    last = _history(folder)[-1:] or [{}]
    kept = (*PACKAGES, "python", "git", "device")
    return {name: last[0][name] for name in kept if name in last[0]}


def changes_since(history: list[dict[str, str]], now: dict[str, str]) -> list[str]:
    """What differs from the last of the earlier versions."""
    before = history[-1] if history else now
    return [
        f"{name} {before.get(name)} -> {now[name]}"
        for name in (*PACKAGES, "python", "git", "device")
        if name in now and before.get(name) != now[name]
    ]


def software() -> dict[str, str]:
    """Versions of the packages and of this code; starts no JAX backend."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed as a package"
    return {"python": platform.python_version(), **found, "git": _git_revision()}


def device(count: int) -> str:
    """Number and kind of devices."""
    first = jax.devices()[0]
    return f"{count} x {first.device_kind} ({first.platform})"


def versions() -> dict[str, str]:
    """What this process runs on: packages, code, device, command line."""
    return {
        **software(),
        "device": device(jax.device_count()),
        "machine": f"{platform.platform()}, {os.cpu_count()} CPUs",
        "command": " ".join(sys.argv),
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }


def _git_revision() -> str:
    """Revision of the working directory, with a mark for uncommitted changes."""
    try:
        done = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12"],
            capture_output=True,
            text=True,
            timeout=10,
            check=False,
            cwd=Path(__file__).parent,
        )
    except (OSError, subprocess.TimeoutExpired):
        return "unknown"
    return done.stdout.strip() or "unknown"
