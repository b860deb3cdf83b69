"""Several agents in one program: every array has one more axis, that of the seeds.

With one seed there is no such axis: the program is that of a single agent.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Key

from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.learning import cloning, devices
from rmp_mjx.training.learning.learner import TrainState
from rmp_mjx.training.learning.ppo import PPO, make_ppo
from rmp_mjx.training.learning.rollout import Env


class Programs(NamedTuple):
    """The compiled parts of an iteration, for all seeds, on all devices."""

    ppo: PPO
    """One agent's functions."""
    mesh: Mesh
    """The devices."""
    init: Callable[[Any], TrainState]
    """First state, from the seeds' keys."""
    clone: Callable[[TrainState, Any, Any], TrainState]
    """`cloning.clone`: all seeds imitate the same observations and actions; consumes
    the state."""
    gather: Callable[[TrainState], Any]
    """`PPO.gather`; consumes the state."""
    learn: Callable[[TrainState, Any], Any]
    """`PPO.learn`; consumes the state."""
    place: Callable[[TrainState], TrainState]
    """Copy a state onto the devices, every array into its own buffer."""


def keys(config: PPOConfig) -> Key[Array, "*k"]:
    """Keys from which the agents start: one key, or (num_seeds,)."""
    if config.num_seeds == 1:
        return jax.random.key(config.seed)
    first, count = np.uint32(config.seed), config.num_seeds
    return jax.vmap(jax.random.key)(first + jnp.arange(count, dtype=np.uint32))


def programs(env: Env, config: PPOConfig, num_devices: int | None = None) -> Programs:
    """Compile PPO for all seeds; the devices share every agent's environments.

    Args:
        env: Single environment.
        config: The learning.
        num_devices: At most this many devices; None: all there are.
    """
    mesh = devices.make_mesh(config.groups, num_devices)
    ppo = make_ppo(env, config, mesh)
    seeded = int(config.num_seeds > 1)
    many = jax.vmap if seeded else lambda function: function
    clone = partial(cloning.clone, ppo)
    whole = devices.placed(mesh, None)
    shardings: dict[str, Any] = {f.name: whole for f in dataclasses.fields(TrainState)}
    shardings["rollout"] = devices.placed(mesh, seeded)
    state = TrainState(**shardings)
    data = devices.placed(mesh, seeded + 1)
    return Programs(
        ppo=ppo,
        mesh=mesh,
        init=jax.jit(many(ppo.init), out_shardings=state),
        clone=jax.jit(
            jax.vmap(clone, (0, None, None)) if seeded else clone,
            donate_argnums=0,
            out_shardings=state,
        ),
        gather=jax.jit(
            many(ppo.gather), donate_argnums=0, out_shardings=(state, data, whole)
        ),
        learn=jax.jit(many(ppo.learn), donate_argnums=0, out_shardings=(state, whole)),
        place=jax.jit(lambda tree: jax.tree.map(jnp.copy, tree), out_shardings=state),
    )


def of_seed(tree: Any, index: int, config: PPOConfig) -> Any:
    """One seed's part of a tree: of a state, of metrics, or of an agent."""
    return jax.tree.map(lambda x: x[index], tree) if config.num_seeds > 1 else tree


def shapes(ppo: PPO, config: PPOConfig) -> TrainState:
    """Shapes and dtypes of the state of all seeds."""
    init = jax.vmap(ppo.init) if config.num_seeds > 1 else ppo.init
    return jax.eval_shape(init, jax.eval_shape(partial(keys, config)))


def check_memory(programs: Programs, config: PPOConfig) -> None:
    """Refuse a training that cannot fit, before anything compiles.

    It holds its state, and its data twice: as they were gathered, and in the order of
    the groups. The first iteration uses the traces that this makes.

    Args:
        programs: The training.
        config: Its options.

    Raises:
        ConfigError: There is less memory.
    """
    state = jax.eval_shape(programs.init, jax.eval_shape(partial(keys, config)))
    _, data, _ = jax.eval_shape(programs.gather, state)
    every, process = programs.mesh.devices.flat, jax.process_index()
    own = [device for device in every if device.process_index == process]
    needed = devices.size(state) + 2 * devices.size(data)
    names = "num_envs, unroll_length, num_seeds or hidden_sizes"
    devices.check_memory(needed * len(own) // len(every), own, names)
