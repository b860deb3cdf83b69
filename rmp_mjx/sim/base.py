"""The interface of every physics engine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from rmp_mjx.pytree import Pytree

PAIR_SENSOR = "touch/"
"""Prefix of the contact sensors that watch one geom pair each."""

CONTACTS_PER_PAIR = 2
"""Contact slots a pair sensor reports: a capsule on a plane touches at two points."""

_FIELDS = (
    mujoco.mjtConDataField.mjCONDATA_FOUND,  # 1 number
    mujoco.mjtConDataField.mjCONDATA_FORCE,  # 3, normal first
    mujoco.mjtConDataField.mjCONDATA_DIST,  # 1
)
_WIDTH = 5


class PhysicsError(ValueError):
    """The engine is unknown, is missing, or cannot simulate this model."""


class PhysicsState(Pytree):
    """Everything that one physics step passes on to the next."""

    qpos: Float[Array, " nq"]
    """Generalised positions."""
    qvel: Float[Array, " nv"]
    """Generalised velocities."""
    warmstart: Float[Array, " nv"]
    """Last acceleration; the constraint solver starts from it."""
    mocap_pos: Float[Array, "k 3"]
    """World positions of the moving obstacles (mocap bodies) [m]."""
    sensors: Float[Array, " s"]
    """Contact sensors of the last step."""
    model: dict[str, Array] = struct.field(default_factory=dict)
    """Fields of the model that this simulation has instead of the engine's own."""


class Contacts(Pytree):
    """Contact of every watched geom pair in one physics step."""

    touching: Bool[Array, " pairs"]
    """Whether the pair's surfaces overlap."""
    force: Float[Array, " pairs"]
    """Sum of the pair's normal forces [N]."""
    overflow: Bool[Array, " pairs"]
    """Whether the pair has more contacts than the sensor reports."""


class Physics(Protocol):
    """One engine with one model; all methods are pure, for one environment."""

    model: mujoco.MjModel

    def init(
        self, qpos: Array, qvel: Array, mocap_pos: Array | None = None
    ) -> PhysicsState:
        """State at rest in the given pose, nothing simulated yet.

        `PhysicsState.replace(model=...)` gives it other values in fields of the model.
        What MuJoCo derives from them when it compiles a model stays as it is: the
        weights of constraints, `*_invweight0`.
        """
        ...

    def step(self, state: PhysicsState, ctrl: Array) -> PhysicsState:
        """Advance by ``model.opt.timestep`` under actuator controls (nu,)."""
        ...


def init_state(
    model: mujoco.MjModel, qpos: Array, qvel: Array, mocap_pos: Array | None
) -> PhysicsState:
    """The state all engines start from."""
    qpos = jnp.asarray(qpos)
    if mocap_pos is None:
        mocap_pos = jnp.asarray(model.body_pos[model.body_mocapid >= 0], qpos.dtype)
    return PhysicsState(
        qpos=qpos,
        qvel=jnp.asarray(qvel, qpos.dtype),
        warmstart=jnp.zeros(model.nv, qpos.dtype),
        mocap_pos=jnp.asarray(mocap_pos, qpos.dtype),
        sensors=jnp.zeros(model.nsensordata, qpos.dtype),
    )


def add_pairs(
    spec: mujoco.MjSpec,
    pairs: Sequence[tuple[str, str]],
    *,
    friction: float = 0.0,
    watched: bool = True,
) -> None:
    """Make contact explicit: only the pairs given here collide.

    Args:
        spec: Scene to edit; call once for each kind of contact.
        pairs: Geom names.
        friction: Sliding friction coefficient; 0 makes the contact frictionless.
        watched: Whether each pair gets a sensor, for `read_contacts`.
    """
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    for a, b in pairs:
        pair = spec.add_pair(name=f"{a}/{b}", geomname1=a, geomname2=b)
        pair.condim = 3 if friction else 1
        pair.friction = [friction or 1.0, friction or 1.0, 0.005, 0.0001, 0.0001]
        if not watched:
            continue
        sensor = spec.add_sensor(name=f"{PAIR_SENSOR}{a}/{b}")
        sensor.type = mujoco.mjtSensor.mjSENS_CONTACT
        sensor.objtype = sensor.reftype = mujoco.mjtObj.mjOBJ_GEOM
        sensor.objname, sensor.refname = a, b
        sensor.intprm[0] = sum(1 << int(field) for field in _FIELDS)
        sensor.intprm[1] = 0  # no reduction: every contact of the pair
        sensor.intprm[2] = CONTACTS_PER_PAIR


def read_contacts(model: mujoco.MjModel, state: PhysicsState) -> Contacts:
    """Contacts of the watched pairs, in the order given to `add_pairs`."""
    rows = _take(state.sensors, _address(model).reshape(-1))
    rows = rows.reshape(-1, CONTACTS_PER_PAIR, _WIDTH)
    touching = (rows[..., 0] > 0) & (rows[..., 4] < 0)
    return Contacts(
        touching=jnp.any(touching, axis=1),
        force=jnp.sum(jnp.where(touching, rows[..., 1], 0.0), axis=1),
        overflow=rows[:, 0, 0] > CONTACTS_PER_PAIR,
    )


def sensor_rows(
    model: mujoco.MjModel,
    found: Float[Array, " pairs"],
    force: Float[Array, " pairs"],
    dist: Float[Array, " pairs"],
) -> Float[Array, " s"]:
    """Sensor data with each pair's contact in its first slot; other sensors are 0.

    Args:
        model: Scene made with `add_pairs`.
        found: Number of contacts of each pair.
        force: Sum of their normal forces [N].
        dist: Signed distance [m].
    """
    zero = jnp.zeros_like(force)
    slot = jnp.stack([found.astype(force.dtype), force, zero, zero, dist], axis=-1)
    sensors = jnp.zeros(model.nsensordata, force.dtype)
    return sensors.at[_address(model)[:, :_WIDTH]].set(slot)


def pair_sensors(model: mujoco.MjModel) -> list[int]:
    """Ids of the sensors that `add_pairs` made, in order."""
    names = (model.sensor(s).name for s in range(model.nsensor))
    return [s for s, name in enumerate(names) if name.startswith(PAIR_SENSOR)]


def _take(x: Array, index: np.ndarray) -> Array:
    """x[index] by slices: XLA's CPU backend gathers one element at a time."""
    if not index.size:
        return x[:0]
    runs = np.split(index, np.flatnonzero(np.diff(index) != 1) + 1)
    return jnp.concatenate([x[run[0] : run[-1] + 1] for run in runs])


def _address(model: mujoco.MjModel) -> np.ndarray:
    """Where each pair's numbers are in the sensor data, (pairs, slots * width)."""
    adr = model.sensor_adr[pair_sensors(model)]
    return adr[:, None] + np.arange(_WIDTH * CONTACTS_PER_PAIR)
