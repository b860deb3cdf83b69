"""Brax's trainer, alone and as Playground uses it, on one of our tasks."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.agents.ppo import networks
from brax.training.agents.ppo import train as brax_ppo

import envs
from envs.brax import BraxTask
from rmp_mjx.training.brax.replicated import device_put_replicated
from tests.envs.arm_tasks import Torques

STEPS = 512
OPTIONS = {
    "num_timesteps": STEPS,
    "num_evals": 2,
    "num_eval_envs": 4,
    "episode_length": 8,
    "num_envs": 8,
    "unroll_length": 4,
    "batch_size": 4,
    "num_minibatches": 2,
    "num_updates_per_batch": 1,
    "normalize_observations": True,
    "network_factory": functools.partial(
        networks.make_ppo_networks,
        policy_hidden_layer_sizes=(8,),
        value_hidden_layer_sizes=(8,),
    ),
}


@pytest.fixture(scope="module")
def limp():
    """A task with a controller that compiles fast."""
    controller = Torques(jnp.zeros(7))
    return envs.load("trajectory", controller=controller, physics="mujoco")


def check(environment, **options):
    with device_put_replicated():
        _, params, metrics = brax_ppo.train(environment, **OPTIONS, **options)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(params))
    assert np.isfinite(metrics["eval/episode_reward"])


@pytest.mark.slow
def test_braxs_ppo_trains_on_a_task_in_braxs_protocol(limp):
    reports = []

    def report(steps, metrics):
        reports.append((steps, float(metrics["eval/episode_reward"])))

    check(BraxTask(limp), progress_fn=report)
    assert reports[-1][0] >= STEPS


def test_playgrounds_wrapper_trains_on_a_task(limp):
    playground = pytest.importorskip(
        "mujoco_playground", reason="needs Playground, which is not among the locked"
    )
    check(limp, wrap_env_fn=playground.wrapper.wrap_for_brax_training)
