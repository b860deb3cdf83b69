"""Build the MuJoCo scene of a task: arena, arm, objects, spheres, contact pairs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import mujoco
import numpy as np
from flax import struct

from rmp_mjx.pytree import Pytree
from rmp_mjx.robot import Robot
from rmp_mjx.sim import add_pairs

ASSETS = Path(__file__).parent / "assets"

TABLE_HEIGHT = -0.112
"""Height of the table top, the Jaco 2's base being at 0 [m]."""

ARM = "arm/"
"""Prefix of the arm's names in a scene."""


class Contacts(Pytree):
    """Geoms of a task's objects that take part in contact, by name (all static)."""

    fixtures: tuple[str, ...] = struct.field(pytree_node=False, default=())
    """Geoms that no part of the arm may touch."""
    work: tuple[str, ...] = struct.field(pytree_node=False, default=())
    """Geoms that the hand may touch, and no other part of the arm."""
    work_friction: float = struct.field(pytree_node=False, default=0.5)
    """Sliding friction of the hand on them."""
    passive: tuple[tuple[str, str, float], ...] = struct.field(
        pytree_node=False, default=()
    )
    """Contacts without the arm: two geoms and their sliding friction."""


class Scene(Pytree):
    """A compiled scene and the meaning of its watched contact pairs (all static)."""

    model: mujoco.MjModel = struct.field(pytree_node=False)
    """The scene; the arm's joints come first."""
    hand: np.ndarray = struct.field(pytree_node=False)
    """Pairs of the hand with geoms that it must not touch, (pairs,) bool."""
    arm: np.ndarray = struct.field(pytree_node=False)
    """Pairs of any other link with geoms outside the arm."""
    obstacle: np.ndarray = struct.field(pytree_node=False)
    """Pairs of hand or arm with a sphere."""
    self_pairs: np.ndarray = struct.field(pytree_node=False)
    """Pairs of two links of the arm."""
    work: np.ndarray = struct.field(pytree_node=False)
    """Pairs of the hand with geoms that it may touch."""
    spheres: int = struct.field(pytree_node=False)
    """Obstacle spheres (mocap bodies, in order)."""
    capsule: np.ndarray = struct.field(pytree_node=False)
    """The arm's capsule in each pair of hand or arm; these pairs come first."""
    other: np.ndarray = struct.field(pytree_node=False)
    """Id of the other geom in each of them."""


def no_objects(spec: mujoco.MjSpec) -> Contacts:
    """A task with nothing but the table."""
    del spec
    return Contacts()


def build_scene(
    robot: Robot,
    sim_dt: float,
    spheres: int = 0,
    sphere_radius: float = 0.05,
    cone: str = "pyramidal",
    objects: Callable[[mujoco.MjSpec], Contacts] = no_objects,
    mount: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
) -> Scene:
    """Compile the arm on its table with the task's objects and obstacle spheres.

    Contact is explicit: the table with every link that can reach it; fixtures, objects
    and spheres with every moving link; and the links that can touch each other.
    Contacts that should not happen are frictionless, because the safety record reads
    their normal forces only.

    Args:
        robot: The arm.
        sim_dt: Timestep [s].
        spheres: Number of obstacle spheres.
        sphere_radius: Their radius [m].
        cone: Friction cone, `pyramidal` or `elliptic`.
        objects: Adds the task's objects and returns which geoms take part in contact.
        mount: Where the arm's base stands, (3,) [m].
    """
    spec = mujoco.MjSpec.from_file(str(ASSETS / "arena.xml"))
    spec.option.timestep = sim_dt
    spec.option.cone = int(cone == "elliptic")
    _put_pedestal(spec, mount)
    arm = robot.mj_spec
    arm.option.timestep = sim_dt  # else attaching warns of a conflict
    spec.attach(arm, prefix=ARM, frame=spec.worldbody.add_frame())
    contacts = objects(spec)
    balls = [_add_sphere(spec, i, sphere_radius) for i in range(spheres)]

    capsules, last = robot.capsules, robot.n - 1
    links = [(ARM + g, k) for g, k in zip(capsules.geom, capsules.segment, strict=True)]
    moving = [(g, k) for g, k in links if k >= 0]
    forbidden = [(g, k, "table") for g, k in links if k >= 1]
    forbidden += [(g, k, x) for x in contacts.fixtures for g, k in moving]
    forbidden += [(g, k, x) for x in contacts.work for g, k in moving if k < last]
    on_spheres = [(g, k, x) for x in balls for g, k in moving]
    self_pairs = [(links[a][0], links[b][0]) for a, b in capsules.pairs]
    work = [(g, x) for x in contacts.work for g, k in moving if k == last]

    world = forbidden + on_spheres
    add_pairs(spec, [(g, x) for g, _, x in world] + self_pairs)
    add_pairs(spec, work, friction=contacts.work_friction)
    for a, b, friction in contacts.passive:
        add_pairs(spec, [(a, b)], friction=friction, watched=False)

    of_hand = np.array([k == last for _, k, _ in world], bool)
    groups = [len(forbidden), len(on_spheres), len(self_pairs), len(work)]
    is_forbidden, is_sphere, is_self, is_work = (
        np.repeat(np.arange(4), groups) == i for i in range(4)
    )
    hand = np.concatenate([of_hand, np.zeros(len(self_pairs) + len(work), bool)])
    model = spec.compile()
    return Scene(
        model=model,
        hand=hand,
        arm=(is_forbidden | is_sphere) & ~hand,
        obstacle=is_sphere,
        self_pairs=is_self,
        work=is_work,
        spheres=spheres,
        capsule=np.array([capsules.geom.index(g[len(ARM) :]) for g, *_ in world], int),
        other=np.array([int(model.geom(x).id) for *_, x in world], int),
    )


def _put_pedestal(spec: mujoco.MjSpec, mount: Sequence[float] | np.ndarray) -> None:
    """Let the pedestal reach from the table to the arm's base."""
    if not np.any(mount):
        return
    pedestal, height = spec.geom("pedestal"), float(mount[2]) - TABLE_HEIGHT
    if height < 1e-3:
        spec.delete(pedestal)
        return
    pedestal.size[1] = 0.5 * height
    pedestal.pos = [mount[0], mount[1], TABLE_HEIGHT + 0.5 * height]


def _add_sphere(spec: mujoco.MjSpec, i: int, radius: float) -> str:
    name = f"sphere_{i}"
    body = spec.worldbody.add_body(name=name, mocap=True, pos=[0, 0, -5])
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[radius, 0, 0],
        rgba=[0.85, 0.2, 0.15, 1],
    )
    return name
