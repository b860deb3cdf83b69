"""Policy and value networks, assembled from Brax's parts."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from brax.training.acme import running_statistics
from brax.training.agents.ppo import networks as ppo_networks
from flax import linen
from jax.tree_util import Partial
from jaxtyping import Array, Float, Key, PRNGKeyArray

Agent = Callable[[Float[Array, "b n"], PRNGKeyArray], Float[Array, "b m"]]
"""Observations and a key to actions in [-1, 1], both batched."""

LOG_STD = "log_value"
"""Name of the policy's log standard deviations among its parameters, Brax's."""

OBS_LIMIT = 10.0
"""Normalised observations are clipped to this many standard deviations."""


def make_networks(
    observation_size: int,
    action_size: int,
    hidden_sizes: tuple[int, ...],
    init_log_std: float,
) -> ppo_networks.PPONetworks:
    """Build the networks: a Gaussian policy with its own deviation, and a value.

    The policy's last layer starts at a tenth of the usual size, so that the first
    actions are centred; its deviation does not depend on the observation.

    Args:
        observation_size: Length of an observation.
        action_size: Length of an action.
        hidden_sizes: Widths of the hidden layers, tanh in between.
        init_log_std: Initial log standard deviation.

    Returns:
        Brax's bundle of policy network, value network and action distribution.
    """

    def preprocess(observation, preprocessor_params):
        return running_statistics.normalize(
            observation, preprocessor_params, max_abs_value=OBS_LIMIT
        )

    return ppo_networks.make_ppo_networks(
        observation_size,
        action_size,
        preprocess_observations_fn=preprocess,
        policy_hidden_layer_sizes=hidden_sizes,
        value_hidden_layer_sizes=hidden_sizes,
        activation=linen.tanh,
        distribution_type="normal",
        noise_std_type="log",
        init_noise_std=math.exp(init_log_std),
        mean_kernel_init_fn=jax.nn.initializers.variance_scaling,
        mean_kernel_init_kwargs={
            "scale": 0.01,
            "mode": "fan_in",
            "distribution": "uniform",
        },
    )


def distribution(networks: ppo_networks.PPONetworks, logits: Float[Array, "*b k"]):
    """Distribution of the actions before clipping: Brax's normal one.

    Args:
        networks: The networks.
        logits: What the policy network says of observations.
    """
    made: Any = networks.parametric_action_distribution.create_dist(logits)
    return made


def bounded(policy: Any, most: Float[Array, ""]) -> Any:
    """Policy parameters with no log standard deviation above a bound."""

    def bound(path, leaf):
        return jnp.minimum(leaf, most) if path[-1].key == LOG_STD else leaf

    return jax.tree_util.tree_map_with_path(bound, policy)


def sample_action(
    networks: ppo_networks.PPONetworks,
    normalizer: Any,
    policy: Any,
    obs: Float[Array, "b n"],
    keys: Key[Array, " b"],
) -> tuple[Float[Array, "b m"], dict[str, Array]]:
    """Draw actions, clipped to [-1, 1]; with them the raw ones and their densities."""
    logits = networks.policy_network.apply(normalizer, policy, obs)
    distribution = networks.parametric_action_distribution
    raw = jax.vmap(distribution.sample_no_postprocessing)(logits, keys)
    extras = {"raw_action": raw, "log_prob": distribution.log_prob(logits, raw)}
    return jnp.clip(raw, -1.0, 1.0), extras


def make_agent(
    networks: ppo_networks.PPONetworks, normalizer, policy_params, deterministic: bool
) -> Agent:
    """Bind parameters to a function from observations to clipped actions.

    The agent is a pytree of its parameters: it can be an argument of a compiled
    function, which then serves other parameters too.
    """
    distribution = networks.parametric_action_distribution

    def act(normalizer, params, obs, key):
        logits = networks.policy_network.apply(normalizer, params, obs)
        if deterministic:
            action = distribution.mode(logits)
        else:
            action = distribution.sample(logits, key)
        return jnp.clip(action, -1.0, 1.0)

    return Partial(act, normalizer, policy_params)


def zero_agent(action_size: int) -> Agent:
    """An agent that always commands the middle of the action range."""
    return lambda obs, key: jnp.zeros((obs.shape[0], action_size))


def random_agent(action_size: int) -> Agent:
    """An agent that draws uniform actions, independently at each step."""
    return lambda obs, key: jax.random.uniform(
        key, (obs.shape[0], action_size), minval=-1.0, maxval=1.0
    )
