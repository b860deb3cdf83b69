"""Runs on a toy task that several test modules look at."""

import jax
import numpy as np
import pytest
from rich.console import Console

from rmp_mjx.training.config import TrainConfig
from rmp_mjx.training.learning.ppo import make_ppo
from rmp_mjx.training.runs import identity, run_folder
from rmp_mjx.training.runs.checkpoint import Checkpointer
from rmp_mjx.training.runs.loop import train
from rmp_mjx.training.runs.saving import Commands
from tests.training import toys

SMALL = {
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


def small(**changes):
    """A small configuration of the counting toy."""
    return TrainConfig(toys.Options()).replace(**{**SMALL, **changes})


def run(folder, console=None, **changes):
    """Train on the counting toy; `folder` may hold a run to resume."""
    steps = SMALL["num_envs"] * SMALL["unroll_length"] * ITERATIONS
    options = {"num_timesteps": steps, "run_dir": str(folder), **changes}
    config = small(**options)
    folder, lock = run_folder.open_run(config)
    with lock:
        console = console or Console(quiet=True)
        commands = Commands(resume="train --resume")
        return train(toys.Counter(), config, folder, console, commands), config


def bits(leaf):
    """A leaf's bytes; of a key, its data's."""
    if jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    return np.asarray(leaf).tobytes()


def newest_state(folder, config):
    """Number and state of the newest checkpoint of a counting toy's run."""
    ppo = make_ppo(toys.Counter(), config.ppo)
    template = jax.eval_shape(ppo.init, jax.random.key(0))
    store = Checkpointer(
        folder / run_folder.CHECKPOINTS,
        read_only=True,
        run_id=identity.run_id(folder / run_folder.CONFIG),
    )
    step, state = store.restore(template, pytest.fail)
    store.close()
    return step, state


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """Folder, result and configuration of an uninterrupted run."""
    folder = tmp_path_factory.mktemp("runs") / "finished"
    result, config = run(folder)
    return folder, result, config
