"""Objects of a task, a door for instance: bodies that nothing but physics moves."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np

from rmp_mjx.viewer.things import SLOTS, Thing

_KINDS = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): ("sphere", 1),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): ("capsule", 2),
    int(mujoco.mjtGeom.mjGEOM_BOX): ("box", 3),
}
"""Shapes that a controller knows, each with the number of its sizes."""


class Objects(NamedTuple):
    """What a scene has besides the things that users move."""

    attach: Callable[[mujoco.MjSpec], None]
    """Adds them to a model; they come after the arm."""
    geoms: tuple[str, ...]
    """Their geoms that the arm can touch: spheres, capsules and boxes."""
    touch: frozenset[str]
    """Those of them that the hand may touch."""
    qpos: np.ndarray
    """Positions of their joints at the start."""
    floor: float
    """Height of what they stand on [m]."""

    def read(self, model: mujoco.MjModel, data: mujoco.MjData) -> tuple[Thing, ...]:
        """Where they are in a state, and how they move; renews its kinematics."""
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        return tuple(self._thing(model, data, name) for name in self.geoms)

    def slots(self, model: mujoco.MjModel) -> dict[str, int]:
        """How many obstacles of each kind there can be with them."""
        kinds = [_KINDS[int(model.geom(name).type[0])][0] for name in self.geoms]
        return {kind: count + kinds.count(kind) for kind, count in SLOTS.items()}

    def _thing(self, model: mujoco.MjModel, data: mujoco.MjData, name: str) -> Thing:
        geom, velocity, wxyz = model.geom(name).id, np.zeros(6), np.zeros(4)
        kind, sizes = _KINDS[int(model.geom_type[geom])]
        mujoco.mju_mat2Quat(wxyz, data.geom_xmat[geom])
        which = mujoco.mjtObj.mjOBJ_GEOM
        mujoco.mj_objectVelocity(model, data, which, geom, velocity, 0)
        return Thing(
            kind,
            tuple(data.geom_xpos[geom]),
            tuple(model.geom_size[geom, :sizes]),
            tuple(wxyz),
            velocity=tuple(velocity[3:]),
            spin=tuple(velocity[:3]),
            hand_may_touch=name in self.touch,
        )


NONE = Objects(lambda spec: None, (), frozenset(), np.zeros(0), 0.0)
"""The free view: there are no objects."""
