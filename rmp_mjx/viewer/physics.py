"""The arm and the things in its way as one MuJoCo model, and its forces."""

from __future__ import annotations

from collections.abc import Sequence, Set

import mujoco
import numpy as np

from rmp_mjx.robot import Robot
from rmp_mjx.viewer.objects import Objects
from rmp_mjx.viewer.things import SLOTS, Thing

_TYPES = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
}
_CONTACTS = (
    mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS,
    mujoco.mjtConstraint.mjCNSTR_CONTACT_PYRAMIDAL,
    mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC,
)
_FAR = 100.0
"""So far below the base is what is not in use [m]."""


def build(robot: Robot, period: float, objects: Objects) -> mujoco.MjModel:
    """The arm, a floor, `SLOTS` things and a task's objects; no link touches another.

    Args:
        robot: The arm; its joints come first.
        period: Timestep [s].
        objects: What physics moves besides the arm.
    """
    spec = robot.mj_spec
    spec.option.timestep = period
    geoms = [g for g in spec.geoms if g.contype or g.conaffinity] or list(spec.geoms)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    for geom in geoms:
        geom.contype = 1
    floor = spec.worldbody.add_geom(name="thing/floor")
    floor.type, floor.size = mujoco.mjtGeom.mjGEOM_PLANE, [0.0, 0.0, 0.05]
    floor.contype, floor.conaffinity, floor.pos = 0, 1, [0.0, 0.0, -_FAR]
    for kind, count in SLOTS.items():
        for k in range(count):
            body = spec.worldbody.add_body(name=f"thing/{kind}{k}", mocap=True)
            geom = body.add_geom(name=f"thing/{kind}{k}")
            geom.type, geom.size = _TYPES[kind], [1.0, 1.0, 1.0]
            geom.contype, geom.conaffinity = 0, 1
    objects.attach(spec)
    return spec.compile()


def is_thing(model: mujoco.MjModel, geom: int) -> bool:
    """Whether a geom is one of the things that users move, or the floor."""
    return model.geom(geom).name.startswith("thing/")


def resize(model: mujoco.MjModel, things: Sequence[Thing], floor: float | None) -> None:
    """Give the slots their sizes, and the floor its height."""
    plane = model.geom("thing/floor").id
    model.geom_pos[plane, 2] = -_FAR if floor is None else floor
    for name, thing in _slots(things):
        geom = model.geom(name).id
        half = _half(thing)
        model.geom_size[geom, : len(thing.size)] = thing.size
        model.geom_rbound[geom] = np.linalg.norm(half)
        model.geom_aabb[geom] = [0.0, 0.0, 0.0, *half]
        body = model.geom_bodyid[geom]
        model.bvh_aabb[model.body_bvhadr[body]] = model.geom_aabb[geom]


def place(model: mujoco.MjModel, data: mujoco.MjData, things: Sequence[Thing]) -> None:
    """Put the things where they are, and the unused slots out of the way."""
    data.mocap_pos[:] = [0.0, 0.0, -_FAR]
    for name, thing in _slots(things):
        slot = model.body(name).mocapid[0]
        data.mocap_pos[slot] = thing.position
        data.mocap_quat[slot] = thing.wxyz


def contact_torque(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Torque of all contacts on each joint in the last step, (nv,) [N m]."""
    torque = np.zeros(model.nv)
    if data.nefc:
        force = np.where(np.isin(data.efc_type, _CONTACTS), data.efc_force, 0.0)
        mujoco.mj_mulJacTVec(model, data, torque, force)
    return torque


def contact_force(
    model: mujoco.MjModel, data: mujoco.MjData, work: Set[int] = frozenset()
) -> float:
    """Sum of the normal forces of all contacts in the last step [N].

    Args:
        model: The model.
        data: Its state.
        work: Geoms that the hand may touch, by id; their contacts are left out.
    """
    wrench, total = np.zeros(6), 0.0
    for k, pair in enumerate(data.contact.geom if data.ncon else ()):
        if work.isdisjoint(pair):
            mujoco.mj_contactForce(model, data, k, wrench)
            total += wrench[0]
    return total


def _slots(things: Sequence[Thing]) -> list[tuple[str, Thing]]:
    """Names of the slots in use, and what is in them."""
    taken = dict.fromkeys(SLOTS, 0)
    found = []
    for thing in things:
        found.append((f"thing/{thing.kind}{taken[thing.kind]}", thing))
        taken[thing.kind] += 1
    return found


def _half(thing: Thing) -> np.ndarray:
    """Half sizes of the box round a thing [m]."""
    if thing.kind == "capsule":
        radius, half = thing.size
        return np.array([radius, radius, half + radius])
    return np.resize(np.array(thing.size), 3)
