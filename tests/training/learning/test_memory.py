"""Sizes are refused by an estimate, before anything compiles."""

import time

import jax
import pytest

from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.evaluation import evaluate
from rmp_mjx.training.learning import memory, seeds
from tests.training import toys
from tests.training.conftest import small

PATIENCE = 30.0
"""Seconds for an estimate: tracing takes one or two, compiling would take more."""
LARGE = {
    "num_envs": 2**30,
    "unroll_length": 2**30,
    "num_seeds": 2**30,
    "hidden_sizes": (2**30, 2**30),
}


def check(**changes):
    config = small(**changes).ppo
    memory.check_training(seeds.programs(toys.Counter(), config), config)


@pytest.mark.parametrize("name", [*LARGE, "all"])
def test_a_training_that_cannot_fit_is_refused_with_the_estimate(name):
    began = time.monotonic()
    changes = LARGE if name == "all" else {name: LARGE[name]}
    with pytest.raises(ConfigError, match=r"at least [\d,.]+ GiB of memory"):
        check(**changes)
    assert time.monotonic() - began < PATIENCE


def test_the_estimate_is_no_more_than_what_is_held(monkeypatch):
    """A lower bound: what is refused could not have run."""
    config = small().ppo
    programs = seeds.programs(toys.Counter(), config)
    needed = []
    monkeypatch.setattr(memory, "check", lambda *given: needed.append(given[0]))
    memory.check_training(programs, config)
    state, data, _ = programs.gather(programs.init(seeds.keys(config)))
    assert needed == [memory.size(state) + 2 * memory.size(data)]
    held = jax.tree.leaves(memory.numbers((state, data)))
    assert memory.size((state, data)) == sum(array.nbytes for array in held)


def test_more_episodes_than_fit_are_refused():
    evaluate.check_size(toys.Counter(), 10**6)
    with pytest.raises(ConfigError, match="lower the number of episodes"):
        evaluate.check_size(toys.Counter(), 2**30)


def test_the_memory_is_the_devices_own_or_the_machines():
    class Device:
        def __init__(self, limit):
            self.limit = limit

        def memory_stats(self):
            return {"bytes_limit": self.limit} if self.limit else None

    assert memory.available([Device(3), Device(4)]) == 7
    assert memory.available([Device(None)]) > 2**28
