"""The committed policies load and act."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.flags import load_config
from rmp_mjx.training.policy import load_policy
from rmp_mjx.training.runs import policies

FOLDER = Path(__file__).resolve().parents[1] / "pretrained"


@pytest.mark.parametrize("controller", ["vices", "rmp_vices"])
@pytest.mark.parametrize("task", ["trajectory", "door", "push"])
def test_a_pretrained_policy_loads_by_its_name_and_acts(task, controller):
    path = policies.find(str(FOLDER / f"{task}-{controller}"))
    config = load_config(path)
    assert (config.task.env, config.task.controller) == (task, controller)
    env = envs.load(task, controller=controller)
    iterations, agent = policies.load_agent(env, config, path, True, pytest.fail)
    assert iterations * config.ppo.steps_per_iteration >= 1_500_000
    obs = jax.random.normal(jax.random.key(0), (50, env.observation_size))
    action = agent(obs, jax.random.key(1))
    assert action.shape == (50, env.action_size)
    assert jnp.all(jnp.abs(action) <= 1.0)
    assert np.std(action, axis=0).min() > 0.0  # every entry depends on what it sees


def test_a_pretrained_policy_says_what_it_was_measured_to_do():
    """The README's table says 96.2 % success, 2.7 % collisions at the door."""
    found = load_policy(FOLDER / "door-rmp_vices.safetensors").about["evaluation"]
    assert (found["task"]["obstacles"], found["task"]["layout"]) == (2, "close")
    assert (found["episodes"], found["deterministic"]) == (1000, True)
    assert (found["success_rate"], found["collision_rate"]) == (0.962, 0.027)
    low, high = found["collision_rate_ci95"]
    assert low < found["collision_rate"] < high


def test_there_is_nothing_but_policies():
    assert {path.suffix for path in FOLDER.iterdir()} == {policies.SUFFIX}
