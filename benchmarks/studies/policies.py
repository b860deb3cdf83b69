"""Policies: random actions, a straight line, an adversary, and a trained one.

A policy is a pair of pure functions of one environment: `start(key) -> memory` and
`act(memory, key, view) -> (memory, action)`, the action in [-1, 1]^12.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rmp_mjx import ACTION_SIZE, ActionRange
from rmp_mjx.training.learning.networks import Agent

MOTION = 6
"""Leading entries of an action that move the set-point; the rest are stiffnesses."""


class View(NamedTuple):
    """What a policy may use."""

    to_target: Array
    """From the end effector to its target, (3,) [m]."""
    to_obstacle: Array
    """Unit vector from the most endangered control point to its obstacle, (3,)."""
    obs: Array
    """The task's observation."""


class Policy(NamedTuple):
    """A policy with a memory."""

    start: Callable[[Array], Array]
    """Its memory (12,) at the start of an episode, from a key."""
    act: Callable[[Array, Array, View], tuple[Array, Array]]
    """New memory and action, from memory, key and view."""


def stiffness(kp: float) -> float:
    """The entry of an action for a stiffness of `kp` [1/s^2]."""
    span = ActionRange()
    u = 2.0 * np.log(kp / span.kp_min) / np.log(span.kp_max / span.kp_min) - 1.0
    return float(u)


def smooth(correlation: float = 0.95, deviation: float = 0.7) -> Policy:
    """An Ornstein-Uhlenbeck process in every entry, clipped to the action range.

    Args:
        correlation: Of one policy step with the next; 0.95 is a time constant of 1 s.
        deviation: Stationary standard deviation before clipping.
    """
    noise = deviation * np.sqrt(1.0 - correlation**2)

    def start(key: Array) -> Array:
        return deviation * jax.random.normal(key, (ACTION_SIZE,))

    def act(memory: Array, key: Array, view: View) -> tuple[Array, Array]:
        del view
        new = correlation * memory + noise * jax.random.normal(key, memory.shape)
        return new, jnp.clip(new, -1.0, 1.0)

    return Policy(start, act)


def hard(hold: float = 20.0, least: float = 0.8, kp: float = 150.0) -> Policy:
    """Motions of at least `least` of the range in either direction, held for a while.

    Args:
        hold: Mean number of policy steps until all entries are drawn anew.
        least: Smallest magnitude of a displacement or rotation entry.
        kp: Smallest stiffness; the largest is the range's end. [1/s^2]
    """
    low = stiffness(kp)

    def start(key: Array) -> Array:
        key_sign, key_size = jax.random.split(key)
        sign = jax.random.rademacher(key_sign, (MOTION,), jnp.float32)
        size = jax.random.uniform(key_size, (ACTION_SIZE,))
        motion = sign * (least + (1.0 - least) * size[:MOTION])
        return jnp.concatenate([motion, low + (1.0 - low) * size[MOTION:]])

    def act(memory: Array, key: Array, view: View) -> tuple[Array, Array]:
        del view
        key_new, key_when = jax.random.split(key)
        again = jax.random.bernoulli(key_when, 1.0 / hold)
        new = jnp.where(again, start(key_new), memory)
        return new, new

    return Policy(start, act)


def straight(kp: float = 150.0) -> Policy:
    """Displace the set-point straight to the target, as far as the range allows.

    Args:
        kp: Stiffness in every direction. [1/s^2]
    """
    reach = ActionRange().dpos
    tail = np.r_[np.zeros(3), np.full(ACTION_SIZE - MOTION, stiffness(kp))]

    def start(key: Array) -> Array:
        del key
        return jnp.zeros(ACTION_SIZE)

    def act(memory: Array, key: Array, view: View) -> tuple[Array, Array]:
        del key
        largest = jnp.max(jnp.abs(view.to_target))
        move = view.to_target / jnp.maximum(largest, reach)
        return memory, jnp.concatenate([move, jnp.asarray(tail, move.dtype)])

    return Policy(start, act)


def adversarial(hold: float = 20.0) -> Policy:
    """Press the arm into the nearest obstacle as hard as the range allows.

    The displacement points from the arm's most endangered point to the obstacle nearest
    to it; rotations are those of the `hard` policy, every stiffness is the greatest.

    Args:
        hold: Mean number of policy steps until the rotations are drawn anew.
    """
    turn = hard(hold)

    def act(memory: Array, key: Array, view: View) -> tuple[Array, Array]:
        memory, _ = turn.act(memory, key, view)
        push = view.to_obstacle
        push = push / jnp.maximum(jnp.max(jnp.abs(push)), 1e-6)
        stiff = jnp.ones(ACTION_SIZE - MOTION)
        return memory, jnp.concatenate([push, memory[3:MOTION], stiff])

    return Policy(turn.start, act)


def trained(agent: Agent) -> Policy:
    """A trained policy; its memory is not used."""

    def start(key: Array) -> Array:
        del key
        return jnp.zeros(ACTION_SIZE)

    def act(memory: Array, key: Array, view: View) -> tuple[Array, Array]:
        return memory, agent(view.obs[None], key)[0]

    return Policy(start, act)


Policies = Mapping[str, Callable[[], Policy]]
"""Policies by name."""

POLICIES: dict[str, Callable[[], Policy]] = {
    "smooth": smooth,
    "hard": hard,
    "straight": straight,
    "adversarial": adversarial,
}
"""The untrained ones, with their default parameters."""
