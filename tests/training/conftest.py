"""Runs on a toy task that several test modules look at."""

import pytest
from rich.console import Console

from rmp_mjx.training import run_folder
from rmp_mjx.training.config import TrainConfig
from rmp_mjx.training.train import train
from tests.training import toys

SMALL = {
    "env": "counter",
    "num_envs": 8,
    "unroll_length": 8,
    "num_minibatches": 2,
    "num_updates_per_batch": 2,
    "hidden_sizes": (4,),
    "checkpoint_interval": 2,
    "eval_episodes": 6,
    "video": False,
}
ITERATIONS = 4


def run(folder, console=None, **changes):
    """Train on the counting toy; `folder` may hold a run to resume."""
    steps = SMALL["num_envs"] * SMALL["unroll_length"] * ITERATIONS
    options = {**SMALL, "num_timesteps": steps, "run_dir": str(folder), **changes}
    config = TrainConfig(**options)
    folder, lock = run_folder.open_run(config)
    with lock:
        console = console or Console(quiet=True)
        return train(toys.Counter(), config, folder, console), config


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """Folder, result and configuration of an uninterrupted run."""
    folder = tmp_path_factory.mktemp("runs") / "finished"
    result, config = run(folder)
    return folder, result, config
