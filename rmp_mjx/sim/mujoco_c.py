"""MuJoCo's C engine on a thread pool, called from inside jit: the CPU path."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np
from jax import Array
from jax.experimental.buffer_callback import buffer_callback

from rmp_mjx.runtime import usable_cores
from rmp_mjx.sim.base import PhysicsState, init_state


class MujocoPhysics:
    """A batch of C simulations, one thread per core, behind a host callback.

    Each step loads the environments' states into a batch and reads the results
    back. The engine keeps no state between steps, so the step is a pure function. Steps
    that run concurrently, on several devices or in two programs, use a batch each.
    """

    def __init__(self, model: mujoco.MjModel):
        """Keep the model; batches are made when they are first needed."""
        self.model = model
        self._idle: dict[tuple[int, int, tuple[str, ...]], list[_Batch]] = {}

    def init(
        self, qpos: Array, qvel: Array, mocap_pos: Array | None = None
    ) -> PhysicsState:
        """State at rest in the given pose, nothing simulated yet."""
        return init_state(self.model, qpos, qvel, mocap_pos)

    def step(self, state: PhysicsState, ctrl: Array) -> PhysicsState:
        """Advance by one timestep.

        A simulation that the engine would reset or stop because of a bad state gives
        NaN, so that it cannot look safe.
        """
        given = (state.qpos, state.qvel, state.warmstart, state.mocap_pos, ctrl)
        good = jnp.all(
            jnp.array([jnp.all(jnp.abs(x) < mujoco.mjMAXVAL) for x in given])
        )
        harmless = (self.model.qpos0, 0.0, 0.0, 0.0, 0.0)
        given = [
            jnp.where(good, x, jnp.asarray(instead, x.dtype))
            for x, instead in zip(given, harmless, strict=True)
        ]
        given += state.model.values()
        results = (state.qpos, state.qvel, state.warmstart, state.sensors)
        shapes = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in results)
        step = functools.partial(self._step_host, _threads(), tuple(state.model))
        moved = jax.lax.platform_dependent(
            *given,
            cpu=functools.partial(_in_place, step, shapes),
            default=functools.partial(_by_copies, step, shapes),
        )
        qpos, qvel, warmstart, sensors = (jnp.where(good, x, jnp.nan) for x in moved)
        return state.replace(qpos=qpos, qvel=qvel, warmstart=warmstart, sensors=sensors)

    def _step_host(self, threads, fields, out, given):
        size = int(np.prod(given[0].shape[:-1], dtype=int))
        idle = self._idle.setdefault((size, threads, fields), [])
        try:
            batch = idle.pop()  # one step of a list: no two callers get the same
        except IndexError:
            batch = _Batch(self.model, size, threads, fields)
        batch.step(out, given)
        idle.append(batch)


class _Batch:
    """Simulations, and the arrays in which the engine keeps their states."""

    def __init__(
        self, model: mujoco.MjModel, size: int, threads: int, fields: tuple[str, ...]
    ):
        self.batch = mujoco.batch.Batch(model, size, threads)
        bind = self.batch.bind
        moving = [bind(name) for name in ("qpos", "qvel", "qacc_warmstart")]
        self.given = [*moving, bind("mocap_pos"), bind("ctrl")]
        self.given += [self.batch.expand(name) for name in fields]
        self.out = [*moving, bind("sensordata")]
        self.time = bind("time")

    def step(self, out, given) -> None:
        """Advance from the given arrays and write into the result arrays."""
        for ours, theirs in zip(self.given, given, strict=True):
            ours[...] = theirs.reshape(ours.shape)
        self.time[...] = 1.0
        self.batch.step()
        # The engine resets a simulation that blows up, its clock included.
        reset = self.time.reshape(-1) < 1.0
        for ours, theirs in zip(self.out, out, strict=True):
            theirs[...] = ours.reshape(theirs.shape)
            if reset.any():
                theirs.reshape(ours.shape)[reset] = np.nan


def _in_place(step, shapes, *given):
    """Call the host, which reads and writes the program's own memory."""

    def call(_, out, *given):
        step([np.asarray(x) for x in out], [np.asarray(x) for x in given])

    return buffer_callback(call, shapes, vmap_method="broadcast_all")(*given)


def _by_copies(step, shapes, *given):
    """Call the host from another device."""

    def call(*given):
        lead = given[0].shape[: given[0].ndim - len(shapes[0].shape)]
        out = [np.empty((*lead, *shape.shape), shape.dtype) for shape in shapes]
        step(out, [np.asarray(x) for x in given])
        return tuple(out)

    return jax.pure_callback(call, shapes, *given, vmap_method="broadcast_all")


def _threads() -> int:
    """Threads of a batch: the cores, shared by the devices that step at once."""
    mesh = jax.sharding.get_abstract_mesh()  # that of an enclosing shard_map
    here = 1 if mesh.empty else max(1, mesh.size // jax.process_count())
    return max(1, usable_cores() // here)
