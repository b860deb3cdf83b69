"""MuJoCo's C engine on a thread pool, called from inside jit: the CPU path."""

from __future__ import annotations

import functools
import os

import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np
from jax import Array

from rmp_mjx.sim.base import PhysicsState, init_state


class MujocoPhysics:
    """A batch of C simulations, one thread per core, behind a host callback.

    Each step loads the environments' states into a batch and reads the results
    back: the engine itself remembers nothing, so the step is a pure function. Steps
    that run at once, those of several devices or of two programs, take a batch each.
    """

    def __init__(self, model: mujoco.MjModel):
        """Keep the model; batches are made when they are first needed."""
        self.model = model
        self._idle: dict[tuple[int, int], list[mujoco.batch.Batch]] = {}

    def init(
        self, qpos: Array, qvel: Array, mocap_pos: Array | None = None
    ) -> PhysicsState:
        """State at rest in the given pose, nothing simulated yet."""
        return init_state(self.model, qpos, qvel, mocap_pos)

    def step(self, state: PhysicsState, ctrl: Array) -> PhysicsState:
        """Advance by one timestep.

        A simulation that the engine would reset or stop because its state is bad comes
        back as NaN: it must not look safe.
        """
        moving = (state.qpos, state.qvel, state.warmstart, state.sensors)
        shapes = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(jnp.shape(x), x.dtype), moving
        )
        qpos, qvel, warmstart, sensors = jax.pure_callback(
            functools.partial(self._step_host, _threads()),
            shapes,
            state.qpos,
            state.qvel,
            state.warmstart,
            state.mocap_pos,
            ctrl,
            vmap_method="broadcast_all",
        )
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            qpos=qpos, qvel=qvel, warmstart=warmstart, sensors=sensors
        )

    def _step_host(self, threads, qpos, *others):
        size = int(np.prod(qpos.shape[:-1], dtype=int))
        idle = self._idle.setdefault((size, threads), [])
        try:
            batch = idle.pop()  # one step of a list: no two callers get the same
        except IndexError:
            batch = mujoco.batch.Batch(self.model, size, threads)
            batch.bind("sensordata")
        out = self._step_batch(batch, *map(np.asarray, (qpos, *others)))
        idle.append(batch)
        return out

    def _step_batch(self, batch, qpos, qvel, warmstart, mocap_pos, ctrl):
        lead, dtype = qpos.shape[:-1], qpos.dtype
        good = np.ones(batch.nsim, bool)
        for x in (qpos, qvel, ctrl, mocap_pos):
            flat = x.reshape(batch.nsim, x.size // batch.nsim)
            good &= np.all(np.abs(flat) < mujoco.mjMAXVAL, axis=1)
        mask = good[:, None]
        batch.qpos[:] = np.where(mask, qpos.reshape(batch.nsim, -1), self.model.qpos0)
        batch.qvel[:] = np.where(mask, qvel.reshape(batch.nsim, -1), 0.0)
        batch.qacc_warmstart[:] = np.where(mask, warmstart.reshape(batch.nsim, -1), 0.0)
        batch.ctrl[:] = np.where(mask, ctrl.reshape(batch.nsim, -1), 0.0)
        if self.model.nmocap:
            batch.mocap_pos[:] = mocap_pos.reshape(batch.nsim, -1, 3)
        batch.time[:] = 1.0
        batch.step()
        # The engine resets a simulation that blows up, its clock included.
        good &= batch.time.reshape(-1) >= 1.0
        out = (batch.qpos, batch.qvel, batch.qacc_warmstart, batch.sensordata)
        return tuple(
            np.where(good[:, None], x, np.nan).astype(dtype).reshape(*lead, -1)
            for x in out
        )


def _threads() -> int:
    """Threads of a batch: the cores, shared by the devices that step at once."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 0
    mesh = jax.sharding.get_abstract_mesh()  # that of an enclosing shard_map
    here = 1 if mesh.empty else max(1, mesh.size // jax.process_count())
    return max(1, (cores or os.cpu_count() or 1) // here)
