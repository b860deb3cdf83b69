"""Door opening: pull a hinged panel open by its handle (VICES' contact task)."""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Literal, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from rmp_mjx.control import Controller
from rmp_mjx.math import quat_to_mat
from rmp_mjx.metric import Metric
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.robot import Robot
from rmp_mjx.robot.kinematics import SiteState
from rmp_mjx.sim import PhysicsState

from . import options
from .base import ArmEnv
from .safety import SafetyRecord
from .scene import ASSETS, Contacts
from .stands import Box, Place
from .task import View
from .types import Entry, Score


class Variant(NamedTuple):
    """A panel and its hinge."""

    mass: float
    """Mass of the panel [kg]."""
    damping: float
    """Damping of the hinge [N m s/rad]."""
    friction: float
    """Dry friction of the hinge [N m]."""


VariantName = Literal["light", "heavy", "vices"]

VARIANTS: dict[VariantName, Variant] = {
    "light": Variant(mass=2.43, damping=0.1, friction=0.0),
    "heavy": Variant(mass=10.4, damping=5.0, friction=2.0),
    "vices": Variant(mass=10.4, damping=10.0, friction=10.0),
}
"""Doors by name: robosuite's; VICES' with a hinge that this action range can turn; and
VICES' own, which it cannot."""

GOAL = 1.04
"""Hinge angle to reach [rad]."""

HANDLE = ("door/front", "door/back", "door/left", "door/right")
"""Geoms of the handle."""


@dataclasses.dataclass(frozen=True)
class DoorOptions(options.Options):
    """Options of door opening."""

    env: ClassVar[str] = "door"
    variant: VariantName = "light"
    """Which door: robosuite's, VICES' with a hinge that can be turned, or VICES' own,
    which this action range cannot turn."""
    episode_length: int = 256
    """Policy steps until the time limit; the paper's is 1024."""
    start_noise: float = 0.005
    """Standard deviation of the start configuration [rad]: the finger starts inside the
    handle, which leaves it 10 mm of play."""


class Door(ArmEnv[DoorOptions]):
    """Open the door to 1.04 rad and hold it there.

    With the hinge's angle a and rate w, a step pays 500 at rest near the goal
    (|1.04 - a| < 0.05 and |w| < 0.1), else 30 (1.04 - |1.04 - a|) - 10 |w|; besides 1
    with the hand on the handle (within 1 cm across and 2 cm in height), else
    0.5 (1 - tanh 3 d); less 0.05 F for a mean contact force F above 100 N. An event
    costs `event_penalty`. Solved once the door has been at rest near the goal for half
    a second.
    """

    Options = DoorOptions
    q_start = np.array([3.363, 4.028, 0.013, 1.847, -0.012, 4.102, 3.178])
    sphere_box = (np.array([0.20, -0.40, 0.0]), np.array([0.60, 0.40, 0.35]))
    task_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("door_angle", "max", unit="rad", headline="angle", table=("mean",)),
    )
    view = View((0.4, 0.02, 0.14), 1.45, -65.0, -26.0)
    """From the other side: the panel would hide the hand."""
    fixture_slots: ClassVar[dict[str, int]] = {"boxes": 2}
    hold = 10
    """Policy steps at rest near the goal that solve the task."""

    def __init__(
        self,
        options: DoorOptions,
        robot: Robot | None = None,
        controller: Controller | None = None,
    ):
        """Read the door's geometry from the compiled scene."""
        super().__init__(options, robot, controller)
        model = self.scene.model
        self.hinge = model.body("door/door").pos
        panel = model.geom("door/panel")
        center, size = _around([model.geom(name) for name in HANDLE])
        self.plates = np.stack([panel.pos, center])
        self.plate_sizes = np.stack([panel.size, size])
        self.grasp_offset = model.site("door/grasp").pos
        self.sweep = self._sweep()

    @classmethod
    def places(cls) -> list[Place]:
        """The handle's arc, with the panel where it is then."""
        model = mujoco.MjModel.from_xml_path(str(ASSETS / "door.xml"))
        hinge, panel = model.body("door").pos, model.geom("panel")
        grasp, found = model.site("grasp").pos, []
        for angle in np.linspace(0.0, GOAL, 6):
            R = np.asarray(_opened(angle), float)
            box = Box(hinge + R @ panel.pos, panel.size, R)
            found.append(Place(hinge + R @ grasp, box))
        return found

    def objects(self, spec: mujoco.MjSpec) -> Contacts:
        """Hang the door: no part of the arm may touch its panel."""
        asset = mujoco.MjSpec.from_file(str(ASSETS / "door.xml"))
        asset.option.timestep = spec.option.timestep
        variant = VARIANTS[self.options.variant]
        asset.geom("panel").mass = variant.mass
        asset.joint("hinge").damping[0] = variant.damping
        asset.joint("hinge").frictionloss = variant.friction
        spec.attach(asset, prefix="door/", frame=spec.worldbody.add_frame())
        return Contacts(fixtures=("door/panel",), work=HANDLE)

    def fixtures(self, slots: Obstacles, data: PhysicsState) -> Obstacles:
        """Panel and handle: bounded plates that turn with their hinge."""
        R, spin = self._turn(data)
        arms = self.plates @ R.T
        return slots.with_boxes(
            self.hinge + arms,
            self.plate_sizes,
            jnp.stack([R, R]),
            velocities=jnp.cross(spin, arms),
            angular_velocities=jnp.stack([spin, spin]),
            hand_may_touch=np.array([False, True]),
        )

    def _sweep(self) -> np.ndarray:
        """Points some 6 cm apart in all that panel and handle pass on their way.

        A sphere of 5 cm that keeps its centre 8 cm from them blocks neither.
        """
        (x, y, z), (_, half, height) = self.plates[0], self.plate_sizes[0]
        panel = [
            (x, -r, h)
            for r in np.linspace(0.08, half - y, 9)
            for h in np.linspace(-self.hinge[2], z + height, 8)
        ]
        bars = [self.scene.model.geom(name) for name in HANDLE]
        handle = [
            bar.pos + share * bar.size[1] * quat_to_mat(bar.quat)[:, 2]
            for bar in bars
            for share in (-0.9, -0.3, 0.3, 0.9)
        ]
        turns = np.stack([_opened(a) for a in np.linspace(0.0, GOAL + 0.06, 8)])
        points = np.einsum("tij,pj->tpi", turns, np.array(panel + handle))
        return self.hinge + points.reshape(-1, 3)

    def _turn(self, data: PhysicsState) -> tuple[Array, Array]:
        """Rotation of the door, and its angular velocity [rad/s]."""
        n = self.robot.n
        angle, rate = data.qpos[n], data.qvel[n]
        return _opened(angle), jnp.array([0.0, 0.0, -1.0]) * rate

    def begin(
        self, rng: Array, q: Float[Array, " n"]
    ) -> tuple[Array, dict[str, Array]]:
        """A closed door."""
        held = jnp.zeros((), jnp.int32)
        return jnp.zeros(1), {"held": held, "grip_force": jnp.zeros(())}

    def keep_clear(self, task: dict[str, Array]) -> Float[Array, "v 3"]:
        """Points all over the volume that panel and handle sweep while they open."""
        return jnp.asarray(self.sweep)

    def grasp_at(self, angle: Array) -> Float[Array, " 3"]:
        """Where the grip belongs in the handle of a door open by `angle` [m]."""
        return self.hinge + _opened(angle) @ self.grasp_offset

    def score(
        self,
        data: PhysicsState,
        site: SiteState,
        record: SafetyRecord,
        task: dict[str, Array],
        step: Array,
    ) -> Score:
        """Reward an open door, the hand on its handle, and gentleness."""
        angle, rate = data.qpos[self.robot.n], jnp.abs(data.qvel[self.robot.n])
        miss = jnp.abs(GOAL - angle)
        resting = (miss < 0.05) & (rate < 0.1)
        reward = jnp.where(resting, 500.0, 30.0 * (GOAL - miss) - 10.0 * rate)
        off = self.grasp_at(angle) - site.p
        across, height = jnp.linalg.norm(off[:2]), jnp.abs(off[2])
        near = 0.5 * (1.0 - jnp.tanh(3.0 * jnp.linalg.norm(off)))
        reward += jnp.where((across < 0.01) & (height < 0.02), 1.0, near)
        force = record.contact_force + record.work_force
        reward -= jnp.where(force > 100.0, 0.05 * force, 0.0)
        held = jnp.where(resting, task["held"] + 1, 0)
        task = {"held": held, "grip_force": record.work_force}
        return Score(task, reward, held >= self.hold, {"door_angle": angle})

    @property
    def task_entries(self) -> tuple[Entry, ...]:
        """The hinge, the handle, and whether the hand is on it."""
        return (
            Entry("angle", 1, "rad", "angle of the hinge"),
            Entry("rate", 1, "rad/s", "its rate"),
            Entry("handle", 3, "m", "from the grip to its place in the handle"),
            Entry("contact", 1, "-", "1 while the hand touches the handle"),
        )

    def observe(
        self, data: PhysicsState, site: SiteState, task: dict[str, Array]
    ) -> dict[str, Array]:
        """Hinge, handle and contact."""
        n = self.robot.n
        return {
            "angle": data.qpos[n],
            "rate": data.qvel[n],
            "handle": self.grasp_at(data.qpos[n]) - site.p,
            "contact": (task["grip_force"] > 0.0).astype(jnp.float32),
        }


def _around(capsules: list) -> tuple[np.ndarray, np.ndarray]:
    """Centre and half sizes of the box around capsules, in their body's frame [m]."""
    half = [c.size[1] * np.abs(quat_to_mat(c.quat)[:, 2]) + c.size[0] for c in capsules]
    low = np.min([c.pos - h for c, h in zip(capsules, half, strict=True)], axis=0)
    high = np.max([c.pos + h for c, h in zip(capsules, half, strict=True)], axis=0)
    return 0.5 * (low + high), 0.5 * (high - low)


def _opened(angle: Array | float) -> Array:
    """Rotation of a door that is open by `angle`, clockwise seen from above."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    return jnp.stack([c, s, zero, -s, c, zero, zero, zero, one]).reshape(3, 3)
