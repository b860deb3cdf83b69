"""Ours: environment, controller, trainer and bare physics, as contestants."""

from __future__ import annotations

import dataclasses
import itertools
import sys
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np
from mujoco import mjx

import envs
import rmp_mjx as rmp
from benchmarks.common import AutodiffRMPVICES, on_all_devices
from benchmarks.peers.brax_trainer import ACTION_SIZE, OBSERVATION_SIZE, SETTINGS, Point
from benchmarks.peers.problem import controller
from benchmarks.peers.worker import Measure, latency, rate, serve
from benchmarks.speed.bench_controller import BATCH, random_states
from rmp_mjx import runtime
from rmp_mjx.metric import SUCCESS, Metric, by_name
from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.learning.ppo import make_ppo

DOORS = {"mujoco": 1024, "mjx": 256}
"""Environments in a batch, by physics engine."""

RATES = {"25x2ms": 0.002, "default": 0.005}
"""Physics timesteps: robosuite's, with 25 a policy step, and our default, with 10."""

DEFAULT_FLAGS = "--default_flags"
"""Argument that leaves XLA's flags as they are."""

ACTIONS = 16
"""Random action batches that a rollout repeats, from the start state each time."""


def door_steps(engine: str, sim_dt: float) -> Measure:
    """Door environment steps a second, RMP-VICES at every physics step."""
    env = envs.load("door", controller="rmp_vices", physics=engine, sim_dt=sim_dt)
    size = DOORS[engine]
    start = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), size))
    shape = (ACTIONS, size, env.action_size)
    actions = list(jax.random.uniform(jax.random.key(1), shape, minval=-1.0))
    step = jax.jit(on_all_devices(env.step, size, (0, 0)))
    states = [start]
    order = itertools.cycle(range(ACTIONS))

    def call():
        i = next(order)
        state = start if i == 0 else states[0]
        states[0] = jax.block_until_ready(step(state, actions[i]))

    return rate(call, size)


def torques(
    make: Callable[..., rmp.RMPVICES | rmp.VICES], batch: int, all_devices: bool = False
):
    """A jitted call of a controller on random states, result ready."""
    robot = rmp.Robot.load("jaco2")
    ctrl = make(robot)
    q, qd, action, obstacles = random_states(robot, batch, seed=0)
    setpoint = jax.jit(jax.vmap(ctrl.setpoint, in_axes=(0, 0, None)))(q, action, 0.0)

    def torque(q, qd, setpoint):
        return ctrl(q, qd, setpoint, obstacles).tau

    args = (q, qd, setpoint)
    if batch == 1:
        args = jax.tree.map(lambda x: x[0], args)
        jitted = jax.jit(torque)
    elif all_devices:
        jitted = jax.jit(on_all_devices(torque, batch, (0, 0, 0)))
    else:
        jitted = jax.jit(jax.vmap(torque))
    return lambda: jax.block_until_ready(jitted(*args))


def trainer_steps() -> Measure:
    """PPO's environment steps a second on the point mass."""
    config = PPOConfig(**SETTINGS)
    ppo = make_ppo(PointTask(), config)
    states = [jax.jit(ppo.init)(jax.random.key(0))]
    iterate = jax.jit(ppo.iterate)

    def call():
        states[0], *_ = jax.block_until_ready(iterate(states[0]))

    return rate(call, config.steps_per_iteration)


@dataclasses.dataclass(frozen=True)
class PointTask:
    """The point mass behind our environment protocol."""

    observation_size = OBSERVATION_SIZE
    action_size = ACTION_SIZE
    dt = 0.05
    episode_length = 1000
    physics = "point mass"

    @property
    def metrics(self) -> dict[str, Metric]:
        """Metrics, as a trainer needs them."""
        return by_name([SUCCESS, Metric("collision", "sum", event=True)])

    def reset(self, rng):
        """Start somewhere."""
        return Point.start(rng, dict.fromkeys(self.metrics, jnp.zeros(())))

    def step(self, state, action):
        """One step."""
        return state.step(action)


def c_loop() -> Measure:
    """``mj_step`` of the trajectory scene in a Python loop, one core [1/s]."""
    model = _scene()
    data = mujoco.MjData(model)
    data.qpos[:] = np.asarray(_at_home().qpos)

    def call():
        for _ in range(100):
            mujoco.mj_step(model, data)

    return rate(call, 100)


def c_batch() -> Measure:
    """``mujoco.batch`` of the trajectory scene on all cores [physics steps/s]."""
    batch = mujoco.batch.Batch(_scene(), DOORS["mujoco"])
    batch.qpos[:] = np.asarray(_at_home().qpos)
    return rate(batch.step, batch.nsim)


def mjx_step() -> Measure:
    """``mjx.step`` of the trajectory scene, vmapped [physics steps/s]."""
    model = mjx.put_model(_scene())
    size = DOORS["mjx"]
    one = mjx.make_data(model).replace(qpos=_at_home().qpos)
    states = [jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *x.shape)), one)]
    step = jax.jit(jax.vmap(partial(mjx.step, model)))

    def call():
        states[0] = jax.block_until_ready(step(states[0]))

    return rate(call, size)


def env_physics(engine: str) -> Measure:
    """Physics steps a second of the whole trajectory environment."""
    env = envs.load("trajectory", controller="rmp_vices", physics=engine)
    size = DOORS[engine]
    start = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), size))
    action = jax.random.uniform(jax.random.key(1), (size, env.action_size), minval=-1.0)
    step = jax.jit(on_all_devices(env.step, size, (0, 0)))
    return rate(
        lambda: jax.block_until_ready(step(start, action)), size * env.n_substeps
    )


def _scene() -> mujoco.MjModel:
    return envs.load("trajectory", physics="mujoco").scene.model


def _at_home():
    env = envs.load("trajectory", physics="mujoco")
    return jax.jit(env.reset)(jax.random.key(0)).data


def measures() -> dict[str, Callable[[], Measure]]:
    """All of our measures by name."""

    def throughput(make):
        return lambda: rate(torques(make, BATCH), BATCH)

    def single(make):
        return lambda: latency(torques(make, 1))

    kinds = {
        "rmp_vices": rmp.RMPVICES,
        "vices": rmp.VICES,
        "rmp2_tree": controller,
        "autodiff": AutodiffRMPVICES,
    }
    found = {f"evals_{name}": throughput(make) for name, make in kinds.items()}
    found |= {f"latency_{name}": single(make) for name, make in kinds.items()}
    for engine in DOORS:
        for name, sim_dt in RATES.items():
            found[f"door_{engine}_{name}"] = partial(door_steps, engine, sim_dt)
        found[f"env_physics_{engine}"] = partial(env_physics, engine)
    return found | {
        "trainer_steps": trainer_steps,
        "c_loop": c_loop,
        "c_batch": c_batch,
        "mjx_step": mjx_step,
    }


if __name__ == "__main__":
    runtime.configure(cpu_flags=DEFAULT_FLAGS not in sys.argv, split_cpu=True)
    serve(measures(), ("rmp-mjx", "jax", "mujoco", "mujoco-mjx", "numpy"))
