"""Small copies of policies: `python -m benchmarks.paper.export RUN pretrained/NAME`.

What is exported is a run folder like any other, only that its checkpoint holds no more
than the policy and the normaliser of its observations: `eval.py --run` takes it as it
is, `train.py --resume` cannot.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from benchmarks.paper import tasks
from envs.flags import load_config, parse
from rmp_mjx import runtime
from rmp_mjx.training.config import ConfigError, TrainConfig, save_config
from rmp_mjx.training.learning import seeds
from rmp_mjx.training.learning.ppo import make_ppo
from rmp_mjx.training.learning.rollout import Env
from rmp_mjx.training.learning.state import TrainState
from rmp_mjx.training.runs import run_folder
from rmp_mjx.training.runs.checkpoint import Checkpointer, CheckpointError


@dataclass(frozen=True)
class Options:
    """Export the policy of a run."""

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    out: Annotated[Path, tyro.conf.Positional]
    """Folder to write; must not exist yet."""
    which: str = "newest"
    """Which checkpoint: newest, best, or its number."""


def needed(env: Env, config: TrainConfig) -> TrainState:
    """Shapes of what acting needs of a training state; the rest is None."""
    whole = seeds.shapes(make_ppo(env, config.ppo), config.ppo)
    learner = whole.learner.replace(value=None, policy_opt=None, value_opt=None)
    return whole.replace(
        learner=learner, scale=None, rollout=None, key=None, iteration=None
    )


def export(env: Env, run: Path, out: Path, which: str = "newest") -> int:
    """Write the policy of a run as a run folder of its own.

    Args:
        env: The run's task.
        run: Run folder.
        out: Folder to write.
        which: Which checkpoint: `newest`, `best`, or its number.

    Returns:
        Size of what was written [bytes].

    Raises:
        ConfigError: `run` is no run folder, or `out` exists.
        CheckpointError: There is no such checkpoint.
    """
    config = load_config(run)
    if out.exists():
        raise ConfigError(f"{out} exists already: delete it, or name another folder")
    kept = Checkpointer(run / run_folder.CHECKPOINTS, read_only=True)
    step, state = kept.restore(needed(env, config), lambda _: None, which)
    kept.close()
    out.mkdir(parents=True)
    small = Checkpointer(out / run_folder.CHECKPOINTS)
    small.save(step, state)
    small.close()
    for note in out.rglob("commit_success.txt"):  # names the folder of this machine
        note.write_text("")
    config = config.replace(run_dir=None, resume=None, overwrite=False)
    save_config(config, out / run_folder.CONFIG)
    versions = run / run_folder.VERSIONS
    if versions.exists():
        shutil.copy(versions, out / run_folder.VERSIONS)
    return sum(path.stat().st_size for path in out.rglob("*") if path.is_file())


def main(args: Sequence[str] | None = None) -> int:
    """Parse and export; returns the exit code."""
    options = parse(Options, args)
    try:
        config = load_config(options.run)
        if options.out.exists():
            raise ConfigError(f"{options.out} exists already")
        runtime.configure()
        size = export(tasks.load(config), options.run, options.out, options.which)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except CheckpointError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"written: {options.out}, {size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
