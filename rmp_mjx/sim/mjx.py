"""MJX: MuJoCo's physics in JAX, for accelerators."""

from __future__ import annotations

import jax
import mujoco
from jax import Array
from mujoco import mjx

from rmp_mjx.sim.base import PhysicsError, PhysicsState, init_state


class MjxPhysics:
    """Steps `mjx.Data` built from the few quantities the state carries."""

    def __init__(self, model: mujoco.MjModel):
        """Put the model on the default device.

        Raises:
            PhysicsError: The model uses a feature that MJX lacks.
        """
        self.model = model
        try:
            self._mjx_model = mjx.put_model(model)
            self._template = mjx.make_data(model)
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
        data = mjx.step(self._mjx_model, data)
        return jax.tree.map(
            lambda new, old: new.astype(old.dtype),
            PhysicsState(
                qpos=data.qpos,
                qvel=data.qvel,
                warmstart=data.qacc_warmstart,
                mocap_pos=data.mocap_pos,
                sensors=data.sensordata,
            ),
            state,
        )
