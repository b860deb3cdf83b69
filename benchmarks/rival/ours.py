"""Ours as the rival's contestant: the same task and settings."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial

import jax

import envs
import rmp_mjx as rmp
from benchmarks.common import on_all_devices
from benchmarks.peers.ours import torques
from benchmarks.peers.worker import Measure, rate, serve
from benchmarks.speed.bench_controller import BATCH
from benchmarks.speed.bench_training import iterations
from envs.cli import make_config
from rmp_mjx import runtime

CONTROLLERS = {"rmp_vices": rmp.RMPVICES, "vices": rmp.VICES}


def evals(name: str) -> Measure:
    """Evaluations a second of the whole batch."""
    return rate(torques(CONTROLLERS[name], BATCH, all_devices=True), BATCH)


def env_steps(name: str, num_envs: int) -> Measure:
    """Policy steps a second under random actions."""
    env = envs.load("trajectory", controller=name, physics="mujoco")
    states = [
        jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), num_envs))
    ]
    shape = (num_envs, env.action_size)
    action = jax.random.uniform(jax.random.key(1), shape, minval=-1.0)
    step = jax.jit(on_all_devices(env.step, num_envs, (0, 0)))

    def call():
        states[0] = jax.block_until_ready(step(states[0], action))

    return rate(call, num_envs)


def training(name: str, num_envs: int) -> Measure:
    """Policy steps a second of training, updates included."""
    config = make_config(controller=name, physics="mujoco", num_envs=num_envs)
    each = iterations(config)
    return rate(lambda: next(each), config.ppo.steps_per_iteration)


def measures(num_envs: int) -> dict[str, Callable[[], Measure]]:
    """Measures by name."""
    found: dict[str, Callable[[], Measure]] = {}
    for name in CONTROLLERS:
        found[f"evals_{name}"] = partial(evals, name)
        found[f"env_steps_{name}"] = partial(env_steps, name, num_envs)
        found[f"training_{name}"] = partial(training, name, num_envs)
    return found


if __name__ == "__main__":
    runtime.configure(split_cpu=True)
    serve(measures(int(sys.argv[1])), ("rmp-mjx", "jax", "mujoco", "numpy"))
