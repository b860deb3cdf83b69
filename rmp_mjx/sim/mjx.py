"""MJX: MuJoCo's physics in JAX, for accelerators."""

from __future__ import annotations

import contextlib
import copy
import io

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

with contextlib.redirect_stdout(io.StringIO()):  # MJX announces missing extras there
    from mujoco import mjx

from rmp_mjx.sim.base import (
    PhysicsError,
    PhysicsState,
    init_state,
    pair_sensors,
    sensor_rows,
)


class MjxPhysics:
    """Steps `mjx.Data` built from the few quantities the state carries.

    It fills the contact sensors itself: MJX 3.17 reports the wrong contacts where a
    sensor has no reduction, and with one it sorts, which about doubles a CPU step.
    """

    def __init__(self, model: mujoco.MjModel):
        """Put the model on the default device.

        Raises:
            PhysicsError: The model uses a feature that MJX lacks.
        """
        self.model = model
        ids = pair_sensors(model)
        self._pairs = np.stack([model.sensor_objid[ids], model.sensor_refid[ids]], 1)
        blind = copy.copy(model)
        blind.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
        try:
            self._mjx_model = mjx.put_model(blind)
            self._template = mjx.make_data(blind)
        except NotImplementedError as error:
            raise PhysicsError(f"MJX cannot simulate this model: {error}") from error

    def init(
        self, qpos: Array, qvel: Array, mocap_pos: Array | None = None
    ) -> PhysicsState:
        """State at rest in the given pose, nothing simulated yet."""
        return init_state(self.model, qpos, qvel, mocap_pos)

    def step(self, state: PhysicsState, ctrl: Array) -> PhysicsState:
        """Advance by one timestep."""
        data = self._template.replace(
            qpos=state.qpos,
            qvel=state.qvel,
            qacc_warmstart=state.warmstart,
            mocap_pos=state.mocap_pos,
            ctrl=ctrl,
        )
        data = mjx.step(self._mjx_model.replace(**state.model), data)
        return jax.tree.map(
            lambda new, old: new.astype(old.dtype),
            PhysicsState(
                qpos=data.qpos,
                qvel=data.qvel,
                warmstart=data.qacc_warmstart,
                mocap_pos=data.mocap_pos,
                sensors=self._sensors(data),
                model=state.model,
            ),
            state,
        )

    def _sensors(self, data: mjx.Data) -> Array:
        """The pairs' sensors; a pair's contacts are summed up in its first slot."""
        contact = data._impl.contact
        a, b = self._pairs[:, :1], self._pairs[:, 1:]
        first, second = contact.geom[:, 0], contact.geom[:, 1]
        match = ((first == a) & (second == b)) | ((first == b) & (second == a))
        match &= contact.dist < 0.0
        force = _normal_forces(self.model, contact, data._impl.efc_force)
        return sensor_rows(
            self.model,
            found=jnp.any(match, axis=1),  # summed up: nothing is left out
            force=jnp.sum(jnp.where(match, force, 0.0), axis=1),
            dist=jnp.min(jnp.where(match, contact.dist, 0.0), axis=1, initial=0.0),
        )


def _normal_forces(model: mujoco.MjModel, contact, efc_force: Array) -> Array:
    """Normal force of every contact, (ncon,) [N]."""
    dim = np.asarray(contact.dim)
    if model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL:
        # The normal force is the sum over the pyramid's edges.
        rows = np.where(dim == 1, 1, 2 * (dim - 1))
    else:
        rows = np.ones_like(dim)
    owner = np.repeat(np.arange(len(dim)), rows)
    edge = np.arange(len(owner)) - np.repeat(np.cumsum(rows) - rows, rows)
    address = np.asarray(contact.efc_address)
    force = efc_force[address[owner] + edge]
    total = jnp.zeros(len(dim), force.dtype).at[owner].add(force)
    return jnp.where(address >= 0, total, 0.0)
