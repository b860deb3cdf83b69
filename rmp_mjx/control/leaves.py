"""The leaves of RMP-VICES besides its two attractors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from jaxtyping import Array, Float

from rmp_mjx.names import unknown
from rmp_mjx.pytree import Pytree
from rmp_mjx.rmp import ScalarLeaf
from rmp_mjx.rmp.leaves.collision import collision_near
from rmp_mjx.rmp.leaves.joint_limit import JointLimitBarrier
from rmp_mjx.rmp.leaves.posture import Posture, soft_posture
from rmp_mjx.robot.model import Robot
from rmp_mjx.shapes import KINDS
from rmp_mjx.types import LeafWeights

CollisionLeaf = ScalarLeaf | Mapping[str, ScalarLeaf | None]
"""A leaf for all obstacles, or one for each kind by name (None: not avoided)."""


class Leaves(Pytree):
    """The safety leaves and the posture; None leaves a branch out of the tree."""

    collision: CollisionLeaf | None = None
    """Leaf between every control point and obstacle, or one for each kind: `spheres`,
    `planes`, `capsules` and `boxes` (None: not avoided). Parameters may be arrays that
    broadcast against (obstacles, points): see `per_link`."""
    self_collision: ScalarLeaf | None = None
    """Leaf between the link capsules that can touch."""
    joint_limit: ScalarLeaf | None = None
    """Leaf on the joints."""
    posture: Posture | None = None
    """Rest configuration, in the inertia metric: fills the null space."""

    def __post_init__(self):
        """Check the kinds of obstacles.

        Raises:
            ValueError: `collision` names an unknown kind, or not all of them.
        """
        if not isinstance(self.collision, Mapping):
            return
        kinds = tuple(KINDS.values())
        for kind in self.collision:
            if kind not in kinds:
                raise ValueError(unknown("kind of obstacle", kind, kinds))
        missing = [kind for kind in kinds if kind not in self.collision]
        if missing:
            raise ValueError(
                f"collision has no leaf for {', '.join(missing)}: give one, or None to "
                "ignore them; with_collision keeps the present leaf of the others"
            )

    @classmethod
    def default(cls, robot: Robot) -> Leaves:
        """Barriers for work near surfaces, and a soft, overdamped posture at home."""
        return cls(
            collision=collision_near(),
            self_collision=collision_near(),
            joint_limit=JointLimitBarrier(robot.q_lower, robot.q_upper),
            posture=soft_posture(robot.q_home),
        )

    def weighted(self, weights: LeafWeights | None) -> Leaves:
        """The leaves with a policy's weights; None: unchanged."""
        if weights is None:
            return self

        def wider(leaf: ScalarLeaf) -> ScalarLeaf:
            return leaf.standing_off(weights.standoff)

        posture = self.posture
        if posture is not None:
            posture = posture.replace(weight=posture.weight * weights.posture)
        return self.replace(collision=_each(wider, self.collision), posture=posture)

    def braking(self, stop_time: Float[Array, ""] | float) -> Leaves:
        """The leaves of an arm that needs this time to stop [s]."""

        def slowed(leaf: ScalarLeaf) -> ScalarLeaf:
            return leaf.braking(stop_time)

        return self.replace(
            collision=_each(slowed, self.collision),
            self_collision=_each(slowed, self.self_collision),
            joint_limit=_each(slowed, self.joint_limit),
        )

    def with_collision(self, collision: CollisionLeaf | None) -> Leaves:
        """The same with another collision leaf.

        Args:
            collision: One for all obstacles, or one for some kinds by name. The other
                kinds keep the present leaf.

        Raises:
            ValueError: Unknown kind of obstacle.
        """
        if isinstance(collision, Mapping):
            present = {kind: leaf_of(self.collision, kind) for kind in KINDS.values()}
            collision = present | dict(collision)
        return self.replace(collision=collision)


def _each(
    change: Callable[[ScalarLeaf], ScalarLeaf], leaf: CollisionLeaf | None
) -> Any:
    """A changed leaf, or those of each kind; None stays None."""
    if isinstance(leaf, Mapping):
        return {kind: _each(change, own) for kind, own in leaf.items()}
    return None if leaf is None else change(leaf)


def leaf_of(leaf: CollisionLeaf | None, kind: str) -> ScalarLeaf | None:
    """The leaf that avoids obstacles of this kind."""
    return leaf[kind] if isinstance(leaf, Mapping) else leaf
