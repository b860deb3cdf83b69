"""Where an arm stands, and a finger for an arm that has a bare flange."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np

from rmp_mjx.robot.errors import Numbers, vector

LENGTH = 0.15
"""From the flange to the grip [m]: handles and blocks stay clear of the flange."""

RADIUS = 0.022
"""Of the finger [m], as of the Jaco 2's closed fingers."""

TIP = 0.0175
"""The finger's axis ends so far before the grip [m], as the Jaco 2's."""

MASS = 0.06
"""Of the finger [kg]."""


def stand_at(spec: mujoco.MjSpec, place: Numbers) -> None:
    """Move a fixed base, and all else that is in the world.

    Args:
        spec: The file, which is changed.
        place: By how much, (3,) [m].
    """
    shift, world = vector("mount", place, 3), spec.worldbody
    if shift.any():
        for part in (*world.bodies, *world.geoms, *world.sites, *world.frames):
            part.pos = np.asarray(part.pos) + shift


def add_finger(spec: mujoco.MjSpec, site: str, turn: float) -> str:
    """Put a rigid finger at a site, along its z axis, and a new site on its tip.

    Seen from that grip, the finger touches what the Jaco 2's closed fingers touch.

    Args:
        spec: The file, which is changed.
        site: Name of the flange's site; z points out of the hand.
        turn: Angle of the grip about the finger [rad].

    Returns:
        Name of the grip's site.
    """
    flange = spec.site(site)
    body = flange.parent.add_body(
        name=_free("finger", [b.name for b in spec.bodies]),
        pos=flange.pos,
        quat=flange.quat,
    )
    body.add_geom(
        name=_free("finger", [g.name for g in spec.geoms]),
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=np.full(3, RADIUS),
        fromto=[0.0, 0.0, 0.0, 0.0, 0.0, LENGTH - TIP],
        mass=MASS,
        contype=1,
        conaffinity=1,
        rgba=[0.35, 0.36, 0.4, 1.0],
    )
    grip = body.add_site(
        name=_free("grip", [s.name for s in spec.sites]),
        pos=[0.0, 0.0, LENGTH],
        quat=[np.cos(0.5 * turn), 0.0, 0.0, np.sin(0.5 * turn)],
    )
    return grip.name


def _free(name: str, taken: list[str]) -> str:
    """The name, or the name and a number where it is taken."""
    names = itertools.chain([name], (f"{name}_{k}" for k in itertools.count(1)))
    return next(name for name in names if name not in taken)
