"""Things in the arm's way, as the viewer's users put them there."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from rmp_mjx.obstacles import Obstacles
from rmp_mjx.shapes import Boxes, Capsules, Planes, Spheres

SLOTS = {"sphere": 8, "capsule": 4, "box": 4}
"""Things of each kind that there can be."""
SIZES = {"sphere": (0.06,), "capsule": (0.04, 0.15), "box": (0.06, 0.06, 0.06)}
"""Sizes of new things [m]: radius; radius and half length; half sizes."""
SWING = 0.3
"""A moving thing turns back so far from its place [m]."""


@dataclasses.dataclass(frozen=True)
class Thing:
    """One obstacle."""

    kind: str
    """`sphere`, `capsule` or `box`."""
    position: tuple[float, ...]
    """Centre, world frame [m]."""
    size: tuple[float, ...]
    """As in `SIZES`."""
    wxyz: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    """Orientation; a capsule lies along its z axis."""
    velocity: tuple[float, ...] = (0.0, 0.0, 0.0)
    """World frame [m/s]."""
    place: tuple[float, ...] | None = None
    """Where it was put [m]; None: at `position`."""
    spin: tuple[float, ...] = (0.0, 0.0, 0.0)
    """Angular velocity, world frame [rad/s]."""
    hand_may_touch: bool = False
    """Whether the hand need not avoid it."""

    def __post_init__(self):
        """Check the numbers.

        Raises:
            ValueError: The kind is unknown, or a number is not finite or not positive.
        """
        if self.kind not in SLOTS:
            raise ValueError(f"kind must be one of {', '.join(SLOTS)}: '{self.kind}'")
        wanted = len(SIZES[self.kind])
        if len(self.size) != wanted or not all(0 < s < 10 for s in self.size):
            raise ValueError(
                f"a {self.kind} has {wanted} positive sizes [m], got {self.size}"
            )
        for name in ("position", "wxyz", "velocity", "spin"):
            if not np.all(np.isfinite(getattr(self, name))):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)}")

    def moved(self, dt: float) -> Thing:
        """The thing a moment later [s]; it turns back at the end of its swing."""
        if not any(self.velocity):
            return self
        place = np.array(self.place or self.position)
        velocity = np.array(self.velocity)
        position = np.array(self.position) + velocity * dt
        away = position - place
        if np.linalg.norm(away) > SWING and away @ velocity > 0:
            velocity = -velocity
        return dataclasses.replace(
            self, position=tuple(position), velocity=tuple(velocity), place=tuple(place)
        )

    def put(
        self,
        position: Sequence[float] | np.ndarray,
        wxyz: Sequence[float] | np.ndarray | None = None,
    ) -> Thing:
        """The thing in another place."""
        return dataclasses.replace(
            self,
            position=tuple(map(float, position)),
            wxyz=self.wxyz if wxyz is None else tuple(map(float, wxyz)),
            place=None,
        )

    @property
    def rotation(self) -> np.ndarray:
        """Orientation as a matrix, (3, 3)."""
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, np.array(self.wxyz) / np.linalg.norm(self.wxyz))
        return matrix.reshape(3, 3)


def obstacles(
    things: Sequence[Thing], floor: float | None, slots: Mapping[str, int] = SLOTS
) -> Obstacles:
    """The same as obstacles of a controller, float32, in slots and one plane.

    Args:
        things: The things.
        floor: Height of the floor [m]; None: there is none.
        slots: Number of obstacles of each kind, in use or not.
    """
    kinds = {kind: [t for t in things if t.kind == kind] for kind in slots}

    def rows(kind: str, values: Sequence, default: Sequence[float]) -> np.ndarray:
        full = np.tile(np.asarray(default, np.float32), (slots[kind], 1))
        if values:
            full[: len(values)] = values
        return full

    def common(kind: str) -> dict[str, np.ndarray]:
        return {
            "velocity": rows(kind, [t.velocity for t in kinds[kind]], [0.0] * 3),
            "center": rows(kind, [t.position for t in kinds[kind]], [0.0] * 3),
            "hand_may_touch": rows(
                kind, [(t.hand_may_touch,) for t in kinds[kind]], [0.0]
            )[:, 0].astype(bool),
            "active": np.arange(slots[kind]) < len(kinds[kind]),
        }

    def radius(kind: str) -> np.ndarray:
        return rows(kind, [t.size[:1] for t in kinds[kind]], [1.0])[:, 0]

    def spin(kind: str) -> np.ndarray:
        return rows(kind, [t.spin for t in kinds[kind]], [0.0] * 3)

    turned = np.tile(np.eye(3, dtype=np.float32), (slots["box"], 1, 1))
    for k, thing in enumerate(kinds["box"]):
        turned[k] = thing.rotation
    return Obstacles(
        spheres=Spheres(radius=radius("sphere"), **common("sphere")),
        planes=Planes(
            point=np.array([[0.0, 0.0, floor or 0.0]], np.float32),
            normal=np.array([[0.0, 0.0, 1.0]], np.float32),
            velocity=np.zeros((1, 3), np.float32),
            hand_may_touch=np.zeros(1, bool),
            active=np.array([floor is not None]),
        ),
        capsules=Capsules(
            axis=rows(
                "capsule", [t.rotation[:, 2] for t in kinds["capsule"]], [0, 0, 1]
            ),
            half_length=rows("capsule", [t.size[1:] for t in kinds["capsule"]], [0.0])[
                :, 0
            ],
            radius=radius("capsule"),
            angular_velocity=spin("capsule"),
            **common("capsule"),
        ),
        boxes=Boxes(
            rotation=turned,
            half_size=rows("box", [t.size for t in kinds["box"]], [1.0] * 3),
            radius=np.zeros(slots["box"], np.float32),
            angular_velocity=spin("box"),
            **common("box"),
        ),
    )


SCENES: dict[str, tuple[Thing, ...]] = {
    "free": (),
    "sphere": (Thing("sphere", (0.45, 0.0, 0.45), (0.08,)),),
    "table": (Thing("box", (0.55, 0.0, 0.1), (0.25, 0.4, 0.1)),),
    "gate": (
        Thing("capsule", (0.45, 0.25, 0.3), (0.04, 0.3)),
        Thing("capsule", (0.45, -0.25, 0.3), (0.04, 0.3)),
        Thing("box", (0.45, 0.0, 0.68), (0.04, 0.3, 0.04)),
    ),
    "traffic": (
        Thing("sphere", (0.45, 0.2, 0.5), (0.06,), velocity=(0.0, 0.15, 0.0)),
        Thing("sphere", (0.35, -0.2, 0.7), (0.06,), velocity=(0.1, 0.0, 0.0)),
        Thing("sphere", (0.25, 0.0, 0.9), (0.06,), velocity=(0.0, -0.1, 0.1)),
    ),
}
"""Things to begin with, by name."""
