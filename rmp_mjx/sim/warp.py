"""MuJoCo Warp behind MJX: the same physics in CUDA kernels, for NVIDIA GPUs."""

from __future__ import annotations

import contextlib
import importlib
import io
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from jax import Array

with contextlib.redirect_stdout(io.StringIO()):  # MJX announces missing extras there
    from mujoco import mjx

from rmp_mjx.sim.base import PhysicsError, PhysicsState, init_state


class WarpPhysics:
    """Steps all worlds of a batch in one call, however deeply it is vmapped.

    Warp keeps the contacts of all worlds in one list of fixed length. The batch is made
    once the number of worlds is known, with room for every contact that the scene's
    pairs can have, so none is lost. Sensors are Warp's own. It computes in single
    precision. It also runs on a CPU, slowly.
    """

    def __init__(self, model: mujoco.MjModel):
        """Put the model on the GPU, or on the CPU without one.

        Raises:
            PhysicsError: JAX runs on neither, or the model uses a feature that Warp
                lacks.
        """
        if jax.default_backend() not in ("cpu", "gpu"):
            raise PhysicsError(
                "physics 'warp' runs on an NVIDIA GPU or a CPU, and JAX's backend is "
                f"'{jax.default_backend()}': choose physics 'mjx'"
            )
        warp = importlib.import_module("warp")
        warp.config.log_level = warp.LOG_WARNING  # else it announces every kernel
        self.model = model
        self._contacts, self._rows = capacity(model)
        try:
            self._mjx_model = _quiet(mjx.put_model(model, impl="warp"))
        except NotImplementedError as error:
            raise PhysicsError(f"Warp cannot simulate this model: {error}") from error
        self._templates: dict[int, Any] = {}
        self._step_worlds = _flattened(self._simulate)

    def init(
        self, qpos: Array, qvel: Array, mocap_pos: Array | None = None
    ) -> PhysicsState:
        """State at rest in the given pose, nothing simulated yet."""
        return init_state(self.model, qpos, qvel, mocap_pos)

    def step(self, state: PhysicsState, ctrl: Array) -> PhysicsState:
        """Advance by one timestep.

        Raises:
            PhysicsError: The state has fields of the model of its own.
        """
        if state.model:
            raise PhysicsError(
                f"physics 'warp' has one model for all: {', '.join(state.model)} "
                "cannot differ; choose mujoco or mjx"
            )
        one = jax.tree.map(lambda x: x[None], (state, ctrl))
        return jax.tree.map(lambda x: x[0], self._step_worlds(*one))

    def _simulate(self, states: PhysicsState, ctrl: Array) -> PhysicsState:
        """One timestep of every world; each array has a leading axis of worlds."""
        template = self._template(ctrl.shape[0])

        def one(state: PhysicsState, ctrl: Array) -> PhysicsState:
            data = template.replace(
                qpos=state.qpos.astype(jnp.float32),
                qvel=state.qvel.astype(jnp.float32),
                qacc_warmstart=state.warmstart.astype(jnp.float32),
                mocap_pos=state.mocap_pos.astype(jnp.float32),
                ctrl=ctrl.astype(jnp.float32),
            )
            data = mjx.step(self._mjx_model, data)
            after = PhysicsState(
                qpos=data.qpos,
                qvel=data.qvel,
                warmstart=data.qacc_warmstart,
                mocap_pos=data.mocap_pos,
                sensors=data.sensordata,
            )
            return jax.tree.map(lambda new, old: new.astype(old.dtype), after, state)

        return jax.vmap(one)(states, ctrl)

    def _template(self, worlds: int) -> Any:
        """Data of one world, with room for the contacts of `worlds` of them."""
        if worlds not in self._templates:
            with jax.ensure_compile_time_eval():
                self._templates[worlds] = mjx.make_data(
                    self.model,
                    impl="warp",
                    naconmax=worlds * self._contacts,
                    njmax=self._rows,
                )
        return self._templates[worlds]


def _quiet(model: mjx.Model) -> mjx.Model:
    """Do not print if the solver uses all of its iterations; no other engine does."""
    from mujoco.mjx.third_party.mujoco_warp import OverflowType

    flags = model.opt._impl.warn_overflow
    flags &= ~(OverflowType.ITERATIONS | OverflowType.LS_ITERATIONS)
    quiet: Any = model.tree_replace({"opt._impl.warn_overflow": int(flags)})
    return quiet


def capacity(model: mujoco.MjModel) -> tuple[int, int]:
    """Contacts and constraint rows that one world can have at most."""
    pairs = zip(model.pair_geom1, model.pair_geom2, model.pair_dim, strict=True)
    most = [(mujoco.mj_maxContact(model, a, b, -1), int(dim)) for a, b, dim in pairs]
    pyramidal = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    rows = sum(n * (2 * (d - 1) if pyramidal and d > 1 else d) for n, d in most)
    rows += 2 * model.njnt + model.nv + 6 * model.neq  # limits, friction, equalities
    return max(sum(n for n, _ in most), 1), rows


def _flattened(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of arrays with one leading axis, into which every `vmap` is merged."""
    batched = jax.custom_batching.custom_vmap(function)

    @batched.def_vmap
    def rule(size: int, is_batched: Any, *args: Any) -> tuple[Any, Any]:
        def fold(x: Array, mapped: bool) -> Array:
            x = x if mapped else jnp.broadcast_to(x, (size, *x.shape))
            return x.reshape(size * x.shape[1], *x.shape[2:])

        def unfold(x: Array) -> Array:
            return x.reshape(size, x.shape[0] // size, *x.shape[1:])

        out = batched(*jax.tree.map(fold, args, tuple(is_batched)))
        return jax.tree.map(unfold, out), jax.tree.map(lambda _: True, out)

    return batched
