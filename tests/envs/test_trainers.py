"""Brax's trainer, alone and as Playground uses it, on our tasks.

Brax 0.14.2 trains with jax up to 0.9 only (`jax.device_put_replicated` is gone since).
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.agents.ppo import networks
from brax.training.agents.ppo import train as brax_ppo

import envs
from envs.brax import BraxTask
from tests.envs.arm_tasks import Torques

pytestmark = pytest.mark.skipif(
    not hasattr(jax, "device_put_replicated"),
    reason="Brax's own trainer needs jax 0.9 or older",
)
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


@pytest.fixture(scope="module", params=envs.names())
def limp(request):
    """Each task with a controller that compiles fast."""
    controller = Torques(jnp.zeros(7))
    return envs.load(request.param, controller=controller, physics="mujoco")


def check(trained):
    _, params, metrics = trained
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(params))
    assert np.isfinite(metrics["eval/episode_reward"])


def test_braxs_ppo_trains_on_each_task(limp):
    reports = []

    def report(steps, metrics):
        reports.append((steps, float(metrics["eval/episode_reward"])))

    check(brax_ppo.train(environment=BraxTask(limp), progress_fn=report, **OPTIONS))
    assert reports[-1][0] >= STEPS


def test_playgrounds_wrapper_trains_on_each_task(limp):
    playground = pytest.importorskip(
        "mujoco_playground", reason="needs Playground, which is not among the locked"
    )
    wrap = playground.wrapper.wrap_for_brax_training
    check(brax_ppo.train(environment=limp, wrap_env_fn=wrap, **OPTIONS))
