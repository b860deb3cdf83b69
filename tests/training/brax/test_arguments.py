"""Our hyper-parameters under Brax's names, and what is refused."""

import inspect

import jax
import pytest
from brax.training.agents.ppo import train as brax_ppo

from rmp_mjx.training.brax import arguments
from rmp_mjx.training.config import ConfigError, TrainConfig
from tests.training import toys

CONFIG = TrainConfig(toys.Options(), trainer="brax").replace(
    num_envs=24,
    num_timesteps=1000,
    seed=3,
    unroll_length=8,
    num_minibatches=4,
    num_updates_per_batch=5,
    discounting=0.98,
    gae_lambda=0.9,
    learning_rate=2e-4,
    clipping_epsilon=0.3,
    entropy_cost=1e-3,
    vf_coefficient=0.7,
    max_grad_norm=0.4,
    target_kl=0.03,
    reward_scaling=0.05,
)
GIVEN = {
    "seed": 3,
    "num_envs": 24,
    "unroll_length": 8,
    "num_minibatches": 4,
    "batch_size": 6,  # environments of a minibatch
    "num_updates_per_batch": 5,
    "discounting": 0.98,
    "gae_lambda": 0.9,
    "learning_rate": 2e-4,
    "clipping_epsilon": 0.3,
    "entropy_cost": 1e-3,
    "vf_loss_coefficient": 0.7,
    "max_grad_norm": 0.4,
    "learning_rate_schedule": "ADAPTIVE_KL",
    "desired_kl": 0.03,
    "reward_scaling": 0.05,
    "normalize_observations": True,
    # 6 iterations of 192 steps; Brax's epochs are their number less one
    "num_timesteps": 1152,
    "num_evals": 7,
}


def test_every_hyperparameter_has_its_place_in_braxs_trainer():
    given = arguments.arguments(toys.Counter(), CONFIG)
    assert {name: given[name] for name in GIVEN} == GIVEN
    assert set(given) <= set(inspect.signature(brax_ppo.train).parameters)


def test_without_a_target_the_learning_rate_stays():
    given = arguments.arguments(toys.Counter(), CONFIG.replace(target_kl=0.0))
    assert given["learning_rate_schedule"] == "NONE"


def test_a_training_step_of_brax_is_an_iteration_of_ours():
    given = arguments.arguments(toys.Counter(), CONFIG)
    step = given["batch_size"] * given["num_minibatches"] * given["unroll_length"]
    assert step == CONFIG.ppo.steps_per_iteration


def test_networks_are_ours_whatever_brax_proposes():
    factory = arguments.arguments(toys.Counter(), CONFIG)["network_factory"]
    networks = factory((3,), 1, preprocess_observations_fn=None)
    policy = networks.policy_network.init(jax.random.key(0))
    shapes = {leaf.shape for leaf in jax.tree.leaves(policy)}
    assert (3, CONFIG.ppo.hidden_sizes[0]) in shapes


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"resume": "runs/x"}, "resume"),
        ({"num_seeds": 2}, "num_seeds"),
        ({"num_envs": 6, "num_minibatches": 4}, "num_minibatches"),
    ],
)
def test_what_brax_cannot_do_is_refused_by_name(changes, named):
    with pytest.raises(ConfigError, match=named):
        CONFIG.replace(**changes)


def test_devices_share_environments_and_minibatches_equally(monkeypatch):
    monkeypatch.setattr(jax, "local_device_count", lambda: 4)
    assert arguments.devices(CONFIG) == 3  # 6 environments in a minibatch
    assert arguments.devices(CONFIG.replace(num_devices=2)) == 2
    assert arguments.devices(CONFIG.replace(num_envs=20)) == 1
