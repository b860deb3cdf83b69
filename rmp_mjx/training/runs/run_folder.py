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

from rmp_mjx.files import read_json, replacing, write_text
from rmp_mjx.training.config import ConfigError, TrainConfig
from rmp_mjx.training.records import (
    RecordedTask,
    config_of,
    differing_fields,
    read_record,
    save_config,
)
from rmp_mjx.training.runs import identity, trackers

CONFIG = "config.json"
VERSIONS = "versions.json"
METRICS = "metrics.parquet"
CHECKPOINTS = "checkpoints"
POLICY = "policy.safetensors"
TENSORBOARD = "tensorboard"
DEMOS = "demos.parquet"
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
PAGE = "report.html"
WORST = "worst"
WORST_INDEX = f"{WORST}/index.json"
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
    DEMOS,
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
    PAGE,
    WORST,
)


def default_run_dir(config: TrainConfig) -> Path:
    """A new folder name under runs/, from the task, the seed and the time."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    task = config.task.title.replace(", ", "-")
    return Path("runs") / name_of(f"{task}-seed{config.ppo.seed}-{stamp}")


def name_of(text: str) -> str:
    """A folder's name: to some programs a colon would make it another machine's."""
    return text.replace(":", ".")


def seed_folders(config: TrainConfig, folder: Path) -> list[Path]:
    """Where the results of each seed go."""
    first = config.ppo.seed
    numbers = range(first, first + config.ppo.num_seeds)
    return [seed_folder(config, folder, number) for number in numbers]


def seed_folder(config: TrainConfig, folder: Path, seed: int) -> Path:
    """Where a seed's results go: the run's folder itself if it has one seed."""
    return folder if config.ppo.num_seeds == 1 else folder / SEEDS / str(seed)


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
        strange = not (folder / LOCK).exists()
        lock = _lock(folder)
        try:
            if not (run.resume or is_fresh(folder)):
                _make_room(folder, run.overwrite)
        except (ConfigError, OSError):
            if strange:
                (folder / LOCK).unlink()
            lock.close()
            raise
    except OSError as error:
        raise ConfigError(f"cannot write to {folder}: {error.strerror}") from error
    return folder, lock


def is_fresh(folder: Path) -> bool:
    """Whether a folder has nothing but a lock."""
    return all(path.name == LOCK for path in folder.iterdir())


def discard(folder: Path) -> None:
    """Remove a folder that has nothing but a lock; the lock must be held."""
    if is_fresh(folder):
        (folder / LOCK).unlink(missing_ok=True)
        folder.rmdir()


def _make_room(folder: Path, overwrite: bool) -> None:
    """Delete a run's results, and nothing else; links are removed, never followed.

    Raises:
        ConfigError: They may not go, or they are not certainly those of a run.
    """
    if not overwrite:
        raise ConfigError(
            f"{folder} is not empty: --resume {folder} continues that run, "
            "--overwrite deletes its results"
        )
    try:
        if folder.is_symlink():
            raise ConfigError("it is a link")
        config_of(read_record(folder / CONFIG), RecordedTask)
        if not _history(folder):
            raise ConfigError(f"no {VERSIONS}")
    except ConfigError as error:
        raise ConfigError(
            f"--overwrite deletes the results of a run, and {folder} is not certainly "
            f"one: {error}"
        ) from error
    for name in RESULTS:
        path = folder / name
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def _lock(folder: Path) -> IO[str]:
    """Take the folder's lock; the system releases it when the process ends."""
    if fcntl is None:
        raise ConfigError(
            "training needs Linux or macOS: it locks a run's folder with flock, which "
            f"{platform.system()} does not have"
        )
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW
    lock = os.fdopen(os.open(folder / LOCK, flags, 0o644), "r+")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        owner = lock.read().strip() or "another process"
        lock.close()
        raise ConfigError(f"{folder} is in use by {owner}") from error
    lock.truncate(0)
    lock.write(f"process {os.getpid()} on {platform.node()}\n")
    lock.flush()
    return lock


def describe(
    folder: Path, config: TrainConfig, env: Any, run_id: str | None
) -> list[str]:
    """Write the configuration, the identities and the versions of a run.

    A resumed run adds its versions to those that it was started with.

    Args:
        folder: Its folder.
        config: Its configuration.
        env: Its environment.
        run_id: What tells it from other runs, see `identity.run_id`.

    Returns:
        What has changed since the run was last continued: a resumed run is
        bit-identical to an uninterrupted one only where this is empty.
    """
    identities = {identity.KEY: identity.of(env), identity.RUN: run_id}
    if config.ppo.demos and not (folder / DEMOS).exists():
        with replacing(folder / DEMOS) as copy:
            shutil.copyfile(config.ppo.demos, copy)
    save_config(config, folder / CONFIG, **identities)
    history, now = _history(folder), versions()
    write_text(folder / VERSIONS, json.dumps([*history, now], indent=2) + "\n")
    return changes_since(history, now)


def _history(folder: Path) -> list[dict[str, str]]:
    """Versions that a run was started and continued with.

    Raises:
        ConfigError: The file is damaged.
    """
    path = folder / VERSIONS
    try:
        history = read_json(path)
    except FileNotFoundError:
        return []
    except ValueError as error:
        raise ConfigError(f"{error}; delete it to go on") from error
    if not (
        isinstance(history, list)
        and all(isinstance(start, dict) for start in history)
        and all(isinstance(text, str) for start in history for text in start.values())
    ):
        raise ConfigError(f"{path} has no list of versions; delete it to go on")
    return history


def changed_software(folder: Path) -> list[str]:
    """What is not as it was when a run was last continued; starts no JAX backend."""
    return changes_since(_history(folder), software())


def last_start(folder: Path) -> dict[str, str]:
    """What a run was last started or continued on; empty if that is not known.

    Raises:
        ConfigError: The file is damaged.
    """
    return (_history(folder) or [{}])[-1]


def trained_with(folder: Path) -> dict[str, str]:
    """Packages, code and device that a run was last continued with."""
    last, kept = last_start(folder), (*PACKAGES, "python", "git", "device")
    return {name: last[name] for name in kept if name in last}


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
    """Revision of the checkout, with a mark for uncommitted changes.

    An installed package is not part of the repository that its environment may be in.
    """
    root = Path(__file__).parents[3]
    if not (root / ".git").exists():
        return "unknown"
    try:
        done = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12"],
            capture_output=True,
            text=True,
            timeout=10,
            check=False,
            cwd=root,
        )
    except (OSError, subprocess.TimeoutExpired):
        return "unknown"
    return done.stdout.strip() or "unknown"
