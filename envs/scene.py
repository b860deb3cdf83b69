"""Build the MuJoCo scene of a task: arena, arm, obstacles, watched contact pairs."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
from flax import struct

from rmp_mjx.robot import Robot
from rmp_mjx.sim import watch_pairs

ASSETS = Path(__file__).parent / "assets"

TABLE_HEIGHT = -0.112
"""Height of the table top in the arm's base frame [m]."""

ARM = "arm/"
"""Prefix of the arm's names in a scene."""

HAND_BODIES = (ARM + "link_7", ARM + "fingers")
"""Bodies that count as the hand in the safety record."""


@struct.dataclass
class Scene:
    """A compiled scene and what its watched contact pairs mean (all static)."""

    model: mujoco.MjModel = struct.field(pytree_node=False)
    """The scene."""
    hand: np.ndarray = struct.field(pytree_node=False)
    """Pairs of the hand with the environment, (pairs,) bool."""
    arm: np.ndarray = struct.field(pytree_node=False)
    """Pairs of any other link with the environment."""
    own: np.ndarray = struct.field(pytree_node=False)
    """Pairs of two links of the arm."""
    spheres: int = struct.field(pytree_node=False)
    """Obstacle spheres (mocap bodies, in order)."""


def build_scene(
    robot: Robot, sim_dt: float, spheres: int, sphere_radius: float
) -> Scene:
    """Compile the arm on its table with obstacle spheres.

    Contact is explicit: table with every link that can reach it, spheres with every
    moving link, and the links that can touch each other. These contacts are
    frictionless: none of them is meant to happen, and their normal force is what the
    safety record reads.
    """
    spec = mujoco.MjSpec.from_file(str(ASSETS / "arena.xml"))
    spec.option.timestep = sim_dt
    arm = mujoco.MjSpec.from_string(robot.mjcf)
    arm.option.timestep = sim_dt  # else attaching warns of a conflict
    for key in list(arm.keys):
        arm.delete(key)
    spec.attach(arm, prefix=ARM, frame=spec.worldbody.add_frame())
    for i in range(spheres):
        body = spec.worldbody.add_body(name=f"sphere_{i}", mocap=True, pos=[0, 0, -5])
        body.add_geom(
            name=f"sphere_{i}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[sphere_radius, 0, 0],
            rgba=[0.85, 0.2, 0.15, 1],
        )
    capsules = robot.capsules
    geoms = [ARM + name for name in capsules.geom]
    moving = [g for g, k in zip(geoms, capsules.segment, strict=True) if k >= 0]
    pairs = [
        (g, "table") for g, k in zip(geoms, capsules.segment, strict=True) if k >= 1
    ]
    pairs += [(g, f"sphere_{i}") for i in range(spheres) for g in moving]
    own = [(geoms[a], geoms[b]) for a, b in capsules.pairs]
    watch_pairs(spec, pairs + own, condim=1)
    model = spec.compile()
    bodies = [model.body(model.geom(g).bodyid[0]).name for g, _ in pairs + own]
    with_world = np.array([True] * len(pairs) + [False] * len(own))
    of_hand = np.array([b in HAND_BODIES for b in bodies])
    return Scene(
        model=model,
        hand=with_world & of_hand,
        arm=with_world & ~of_hand,
        own=~with_world,
        spheres=spheres,
    )
