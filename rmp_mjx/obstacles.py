"""The obstacles of a scene: padded slots of fixed shape, filled with what is there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Bool, Float

from rmp_mjx.pytree import Constant, Pytree
from rmp_mjx.refuse import (
    directions,
    not_negative,
    positive,
    refuse_unless,
)
from rmp_mjx.refuse import rotations as are_rotations
from rmp_mjx.shapes import KINDS, TINY, Boxes, Capsules, Gap, Planes, Shape, Spheres
from rmp_mjx.vec import Vec

Kind = TypeVar("Kind", bound=Shape)

Numbers = ArrayLike | Sequence[Any]
"""What `jnp.asarray` takes: arrays, numbers, lists of them."""


class Obstacles(Pytree):
    """All obstacles of a scene. Slots are padded: shapes never change, only contents.

    Build with `empty`, then fill with the `with_...` methods, which return copies and
    work under jit; they use the first slots and switch the others of that kind off.
    """

    spheres: Spheres
    """Balls."""
    planes: Planes
    """Half-spaces."""
    capsules: Capsules
    """Rounded segments."""
    boxes: Boxes
    """Rounded boxes."""

    @staticmethod
    def empty(
        spheres: int = 0, planes: int = 0, capsules: int = 0, boxes: int = 0
    ) -> Obstacles:
        """Slots for so many obstacles of each kind, none in use."""
        up = jnp.array([0.0, 0.0, 1.0])

        def common(n: int) -> dict[str, Array]:
            off = jnp.zeros(n, bool)
            return {"velocity": jnp.zeros((n, 3)), "hand_may_touch": off, "active": off}

        def turning(n: int) -> dict[str, Array]:
            spin = {"angular_velocity": jnp.zeros((n, 3))}
            return common(n) | spin | {"center": jnp.zeros((n, 3))}

        return Obstacles(
            spheres=Spheres(
                center=jnp.zeros((spheres, 3)),
                radius=jnp.ones(spheres),
                **common(spheres),
            ),
            planes=Planes(
                point=jnp.zeros((planes, 3)),
                normal=jnp.tile(up, (planes, 1)),
                **common(planes),
            ),
            capsules=Capsules(
                axis=jnp.tile(up, (capsules, 1)),
                half_length=jnp.zeros(capsules),
                radius=jnp.ones(capsules),
                **turning(capsules),
            ),
            boxes=Boxes(
                rotation=jnp.tile(jnp.eye(3), (boxes, 1, 1)),
                half_size=jnp.zeros((boxes, 3)),
                radius=jnp.ones(boxes),
                **turning(boxes),
            ),
        )

    @property
    def kinds(self) -> tuple[Shape, ...]:
        """The kinds that have at least one slot."""
        every = (self.spheres, self.planes, self.capsules, self.boxes)
        return tuple(kind for kind in every if kind.active.shape[-1])

    def cleared(self) -> tuple[Obstacles, Bool[Array, ""]]:
        """The obstacles without what nobody can use, and whether all can be used.

        A slot that is not in use, or whose numbers mean no obstacle, gets zeros and is
        not in use. So nothing is computed with what was there.

        Returns:
            The obstacles, and False if a slot in use means no obstacle (`Shape.sound`).
        """
        kept, good = [], []
        for slots in vars(self).values():
            sound = slots.sound()
            kept.append(_only(slots, sound & slots.active))
            good.append(jnp.all(sound | ~jnp.asarray(slots.active)))
        return Obstacles(*kept), jnp.all(jnp.stack(good))

    def gaps(
        self, x: Vec, v: Vec, rho: Float[Constant, " p"], hand: Bool[np.ndarray, " p"]
    ) -> dict[str, Gap]:
        """Distances of control points to the obstacles, by kind with any slots.

        Args:
            x: Positions, world frame, (p,) each [m].
            v: Velocities, (p,) each [m/s].
            rho: Radii, (p,) [m].
            hand: Which of them are the hand's, (p,) bool.
        """
        x, v = (vector.map(lambda c: c[None]) for vector in (x, v))
        found = (kind.gap(x, v, rho[None], hand) for kind in self.kinds)
        return {KINDS[type(k)]: gap for k, gap in zip(self.kinds, found, strict=True)}

    def with_spheres(
        self,
        centers: Numbers,
        radii: Numbers,
        velocities: Numbers | None = None,
        *,
        hand_may_touch: Numbers = False,
    ) -> Obstacles:
        """Use the first k sphere slots.

        Args:
            centers: (k, 3), world frame [m].
            radii: (k,) or one number [m].
            velocities: (k, 3) [m/s]; default at rest.
            hand_may_touch: (k,) or one bool; all other links still avoid them.

        Raises:
            ValueError: More than the slots there are, or numbers that mean no sphere.
        """
        _check_vectors(centers=centers, velocities=velocities)
        refuse_unless(positive, "sphere radii", radii, "positive and finite")
        spheres = _fill(
            self.spheres,
            center=centers,
            radius=radii,
            velocity=velocities,
            hand_may_touch=hand_may_touch,
        )
        return self.replace(spheres=spheres)

    def with_planes(
        self,
        points: Numbers,
        normals: Numbers,
        velocities: Numbers | None = None,
        *,
        hand_may_touch: Numbers = False,
    ) -> Obstacles:
        """Use the first k plane slots.

        Args:
            points: A point on each, (k, 3), world frame [m].
            normals: Normals that point out of the obstacles, (k, 3), of any length.
            velocities: Of the surfaces, (k, 3) [m/s]; default at rest.
            hand_may_touch: (k,) or one bool; all other links still avoid them.

        Raises:
            ValueError: More than the slots there are, or numbers that mean no plane.
        """
        _check_vectors(points=points, normals=normals, velocities=velocities)
        refuse_unless(directions, "plane normals", normals, "of some length")
        normals = jnp.asarray(normals, float)
        planes = _fill(
            self.planes,
            point=points,
            normal=normals / jnp.linalg.norm(normals, axis=-1, keepdims=True),
            velocity=velocities,
            hand_may_touch=hand_may_touch,
        )
        return self.replace(planes=planes)

    def with_capsules(
        self,
        starts: Numbers,
        ends: Numbers,
        radii: Numbers,
        velocities: Numbers | None = None,
        angular_velocities: Numbers | None = None,
        *,
        hand_may_touch: Numbers = False,
    ) -> Obstacles:
        """Use the first k capsule slots.

        Args:
            starts: One end of each segment, (k, 3), world frame [m].
            ends: The other end, (k, 3) [m].
            radii: (k,) or one number [m].
            velocities: Of the centres, (k, 3) [m/s]; default at rest.
            angular_velocities: World frame, (k, 3) [rad/s]; default none.
            hand_may_touch: (k,) or one bool; all other links still avoid them.

        Raises:
            ValueError: More than the slots there are, or numbers that mean no capsule.
        """
        _check_vectors(
            starts=starts,
            ends=ends,
            velocities=velocities,
            angular_velocities=angular_velocities,
        )
        refuse_unless(positive, "capsule radii", radii, "positive and finite")
        starts, ends = jnp.asarray(starts, float), jnp.asarray(ends, float)
        length = jnp.linalg.norm(ends - starts, axis=-1)
        axis = (ends - starts) / jnp.maximum(length, TINY)[..., None]
        up = jnp.array([0.0, 0.0, 1.0])
        capsules = _fill(
            self.capsules,
            center=0.5 * (starts + ends),
            axis=jnp.where(length[..., None] > TINY, axis, up),
            half_length=0.5 * length,
            radius=radii,
            velocity=velocities,
            angular_velocity=angular_velocities,
            hand_may_touch=hand_may_touch,
        )
        return self.replace(capsules=capsules)

    def with_boxes(
        self,
        centers: Numbers,
        half_sizes: Numbers,
        rotations: Numbers | None = None,
        radii: Numbers = 0.0,
        velocities: Numbers | None = None,
        angular_velocities: Numbers | None = None,
        *,
        hand_may_touch: Numbers = False,
    ) -> Obstacles:
        """Use the first k box slots.

        Args:
            centers: (k, 3), world frame [m].
            half_sizes: (k, 3), of the core [m].
            rotations: (k, 3, 3), columns are the box's axes; default aligned.
            radii: Rounding added to the core, (k,) or one number [m].
            velocities: Of the centres, (k, 3) [m/s]; default at rest.
            angular_velocities: World frame, (k, 3) [rad/s]; default none.
            hand_may_touch: (k,) or one bool; all other links still avoid them.

        Raises:
            ValueError: More than the slots there are, or numbers that mean no box.
        """
        refuse_unless(positive, "box half sizes", half_sizes, "positive and finite")
        _check_vectors(
            centers=centers,
            half_sizes=half_sizes,
            velocities=velocities,
            angular_velocities=angular_velocities,
        )
        refuse_unless(not_negative, "box radii", radii, "finite and not negative")
        refuse_unless(are_rotations, "box rotations", rotations, "rotation matrices")
        if rotations is None:
            rotations = jnp.tile(jnp.eye(3), (jnp.asarray(centers).shape[0], 1, 1))
        boxes = _fill(
            self.boxes,
            center=centers,
            rotation=rotations,
            half_size=half_sizes,
            radius=radii,
            velocity=velocities,
            angular_velocity=angular_velocities,
            hand_may_touch=hand_may_touch,
        )
        return self.replace(boxes=boxes)


def _only(slots: Kind, use: Array) -> Kind:
    """The slots with zeros where they are not used."""

    def kept(x: Constant) -> Array:
        wide = use.reshape(-1, *(1,) * (jnp.ndim(x) - 1))
        return jnp.where(wide, x, jnp.zeros((), jnp.asarray(x).dtype))

    return jax.tree.map(kept, slots)


def _check_vectors(**given: Numbers | None) -> None:
    """Refuse what are not vectors (k, 3), and known ones that are not finite."""
    for name, values in given.items():
        shape = None if values is None else jnp.asarray(values).shape
        if shape is not None and shape[1:] != (3,):
            raise ValueError(f"{name} must be vectors (k, 3), got shape {shape}")
        refuse_unless(np.isfinite, name, values, "finite")


def _fill(slots: Kind, **contents: Numbers | None) -> Kind:
    """Write k obstacles into the first k slots and switch the rest off."""
    total = slots.active.shape[0]
    first = next(value for value in contents.values() if value is not None)
    k = jnp.asarray(first).shape[0]
    if k > total:
        kind = KINDS[type(slots)]
        raise ValueError(
            f"{k} {kind} do not fit in {total} slots: "
            f"start from Obstacles.empty({kind}={k})"
        )
    filled = {"active": jnp.arange(total) < k}
    for name, value in contents.items():
        old = getattr(slots, name)
        new = (
            jnp.zeros_like(old[:k]) if value is None else jnp.asarray(value, old.dtype)
        )
        filled[name] = old.at[:k].set(jnp.broadcast_to(new, old[:k].shape))
    return slots.replace(**filled)
