"""The committed policies load and act."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.flags import load_config
from rmp_mjx.training.runs.loop import load_agent

FOLDER = Path(__file__).resolve().parents[1] / "pretrained"


@pytest.mark.parametrize("controller", ["vices", "rmp_vices"])
@pytest.mark.parametrize("task", ["trajectory", "door", "push"])
def test_a_pretrained_policy_loads_by_its_name_and_acts(task, controller):
    run = FOLDER / f"{task}-{controller}"
    config = load_config(run)
    assert (config.task.env, config.task.controller) == (task, controller)
    env = envs.load(task, controller=controller)
    iterations, agent = load_agent(env, config, run, True, pytest.fail)
    assert iterations * config.ppo.steps_per_iteration >= 1_500_000
    obs = jax.random.normal(jax.random.key(0), (50, env.observation_size))
    action = agent(obs, jax.random.key(1))
    assert action.shape == (50, env.action_size)
    assert jnp.all(jnp.abs(action) <= 1.0)
    assert np.std(action, axis=0).min() > 0.0  # every entry depends on what it sees
