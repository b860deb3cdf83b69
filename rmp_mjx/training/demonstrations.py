"""Demonstrations: what was seen and done, step by step, as one parquet file."""

import json
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from jaxtyping import Bool, Float, Int

from rmp_mjx.files import replacing
from rmp_mjx.training.config import ConfigError

KEY = "rmp_mjx.demonstrations"
"""Entry of the file's metadata that says what the demonstrations are of, as JSON."""
FORMAT = 1
"""Version of the columns and of the metadata."""
PACKAGES = ("rmp-mjx", "jax", "mujoco")
"""Packages whose versions are written into the metadata."""
FLAGS = ("done", "success")
"""Columns of truth values."""
WIDE = {"observation": "observation_size", "action": "action_size"}
"""Columns of vectors, and where the metadata has their sizes."""


@dataclass(frozen=True)
class Demonstrations:
    """Policy steps of whole episodes, in order, a row each."""

    episode: Int[np.ndarray, " n"]
    """Which episode, from 0."""
    step: Int[np.ndarray, " n"]
    """Policy steps before this one in its episode."""
    observation: Float[np.ndarray, "n o"]
    """What the policy would have seen before the step."""
    action: Float[np.ndarray, "n m"]
    """What was done, in [-1, 1]."""
    reward: Float[np.ndarray, " n"]
    """Reward of the step."""
    done: Bool[np.ndarray, " n"]
    """Whether the task ended the episode with this step; its time limit does not."""
    success: Bool[np.ndarray, " n"]
    """Whether the task was solved after the step."""
    about: dict[str, Any]
    """What they are of, see `describe`."""

    def __post_init__(self):
        """Check sizes and numbers.

        Raises:
            ConfigError: A policy cannot be made of them; the message says why.
        """
        rows = len(self.episode)
        if not rows:
            raise ConfigError("demonstrations need at least one step")
        for name in ("step", "observation", "action", "reward", *FLAGS):
            column = getattr(self, name)
            size = (self.about.get(WIDE[name]),) if name in WIDE else ()
            if column.shape != (rows, *size):
                raise ConfigError(
                    f"{name} of demonstrations has the shape {column.shape}, not "
                    f"{(rows, *size)}"
                )
        for name in ("observation", "action", "reward"):
            column = getattr(self, name).reshape(rows, -1)
            bad = ~np.isfinite(column).all(axis=1)
            if bad.any():
                raise ConfigError(
                    f"{name} of demonstrations is not finite in row {bad.argmax()}"
                )
        if np.abs(self.action).max() > 1.0:
            raise ConfigError("actions of demonstrations must lie within [-1, 1]")

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(np.unique(self.episode))

    def check(self, env: Any) -> None:
        """Refuse another task's environment; arm and controller may be others.

        Raises:
            ConfigError: Task, observations or actions are others.
        """
        here = describe(env, "")
        both = [of | {"task": of["task"].get("env")} for of in (self.about, here)]
        for name in ("task", *WIDE.values(), *WIDE):
            theirs, own = (of.get(name) for of in both)
            if theirs != own:
                raise ConfigError(
                    f"the demonstrations are of another {name.replace('_', ' ')}: "
                    f"{theirs}, not {own}"
                )


def describe(env: Any, source: str) -> dict[str, Any]:
    """What demonstrations in an environment say of it, JSON-ready.

    Args:
        env: The environment; of its `options`, `entries` and `action_names` those that
            it has are used.
        source: Who demonstrates, in words.
    """
    options = getattr(env, "options", None)
    entries = getattr(env, "entries", ())
    return {
        "format": FORMAT,
        "source": source,
        "task": options.record() if options else {},
        "observation": [[entry.name, entry.size] for entry in entries],
        "action": list(getattr(env, "action_names", ())),
        "observation_size": env.observation_size,
        "action_size": env.action_size,
        "dt": env.dt,
        "versions": {name: metadata.version(name) for name in PACKAGES},
    }


def write(path: Path, demonstrations: Demonstrations) -> None:
    """Write demonstrations; `read` gives back the same.

    Args:
        path: The file; its folder must exist.
        demonstrations: What to write.
    """
    d = demonstrations
    columns = {
        "episode": pl.Series(d.episode, dtype=pl.Int32),
        "step": pl.Series(d.step, dtype=pl.Int32),
        **{
            name: pl.Series(
                np.asarray(getattr(d, name), np.float32),
                dtype=pl.Array(pl.Float32, d.about[size]),
            )
            for name, size in WIDE.items()
        },
        "reward": pl.Series(d.reward, dtype=pl.Float32),
        **{name: pl.Series(getattr(d, name), dtype=pl.Boolean) for name in FLAGS},
    }
    with replacing(path) as temporary:
        pl.DataFrame(columns).write_parquet(
            temporary, metadata={KEY: json.dumps(d.about)}
        )


def read(path: Path) -> Demonstrations:
    """Read and check a file that `write` wrote.

    Raises:
        ConfigError: It is no such file, or its numbers cannot be used.
    """
    try:
        about = json.loads(pl.read_parquet_metadata(path)[KEY])
        if about["format"] != FORMAT:
            raise ConfigError(f"format {about['format']}, this version reads {FORMAT}")
        frame = pl.read_parquet(path)
        columns = {name: frame[name].to_numpy() for name in frame.columns}
        return Demonstrations(**columns, about=about)
    except ConfigError as error:
        raise ConfigError(f"{path} cannot be used: {error}") from error
    except FileNotFoundError as error:
        raise ConfigError(f"no file of demonstrations {path}") from error
    except (OSError, ValueError, TypeError, KeyError, pl.exceptions.PolarsError) as bad:
        raise ConfigError(f"{path} is no file of demonstrations") from bad
