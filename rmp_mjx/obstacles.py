"""The obstacles of a scene: padded slots of fixed shape, filled with what is there."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import ArrayLike

from rmp_mjx.pytree import Pytree
from rmp_mjx.shapes import KINDS, TINY, Boxes, Capsules, Gap, Planes, Spheres
from rmp_mjx.vec import Vec


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
            return {"velocity": jnp.zeros((n, 3)), "worked": off, "active": off}

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
    def kinds(self) -> tuple[Spheres | Planes | Capsules | Boxes, ...]:
        """The kinds that have at least one slot."""
        every = (self.spheres, self.planes, self.capsules, self.boxes)
        return tuple(kind for kind in every if kind.active.shape[-1])

    def gaps(self, x: Vec, v: Vec, rho: Array, hand: np.ndarray) -> dict[str, Gap]:
        """Distances of control points to the obstacles, by kind with any slots.

        Args:
            x: Positions, world frame, (p,) each [m].
            v: Velocities, (p,) each [m/s].
            rho: Radii, (p,) [m].
            hand: Which of them are the hand's, (p,) bool.
        """
        return {KINDS[type(kind)]: kind.gap(x, v, rho, hand) for kind in self.kinds}

    def with_spheres(
        self, centers, radii, velocities=None, worked: ArrayLike = False
    ) -> Obstacles:
        """Use the first k sphere slots.

        Args:
            centers: (k, 3), world frame [m].
            radii: (k,) or one number [m].
            velocities: (k, 3) [m/s]; default at rest.
            worked: (k,) or one bool: whether the hand works on them.

        Raises:
            ValueError: More than the slots there are, or a radius that is not positive.
        """
        _check_positive("sphere radii", radii)
        return self.replace(
            spheres=_fill(
                self.spheres,
                center=centers,
                radius=radii,
                velocity=velocities,
                worked=worked,
            )
        )

    def with_planes(
        self, points, normals, velocities=None, worked: ArrayLike = False
    ) -> Obstacles:
        """Use the first k plane slots: a point (k, 3) on each and its normal (k, 3)."""
        normals = jnp.asarray(normals, float)
        unit = normals / jnp.linalg.norm(normals, axis=-1, keepdims=True)
        return self.replace(
            planes=_fill(
                self.planes,
                point=points,
                normal=unit,
                velocity=velocities,
                worked=worked,
            )
        )

    def with_capsules(
        self,
        starts,
        ends,
        radii,
        velocities=None,
        angular_velocities=None,
        worked: ArrayLike = False,
    ) -> Obstacles:
        """Use the first k capsule slots: segments (k, 3) to (k, 3) [m] and radii."""
        _check_positive("capsule radii", radii)
        starts, ends = jnp.asarray(starts, float), jnp.asarray(ends, float)
        length = jnp.linalg.norm(ends - starts, axis=-1)
        axis = (ends - starts) / jnp.maximum(length, TINY)[..., None]
        up = jnp.array([0.0, 0.0, 1.0])
        return self.replace(
            capsules=_fill(
                self.capsules,
                center=0.5 * (starts + ends),
                axis=jnp.where(length[..., None] > TINY, axis, up),
                half_length=0.5 * length,
                radius=radii,
                velocity=velocities,
                angular_velocity=angular_velocities,
                worked=worked,
            )
        )

    def with_boxes(
        self,
        centers,
        half_sizes,
        rotations=None,
        radii=0.0,
        velocities=None,
        angular_velocities=None,
        worked: ArrayLike = False,
    ) -> Obstacles:
        """Use the first k box slots.

        Args:
            centers: (k, 3), world frame [m].
            half_sizes: (k, 3), of the core [m].
            rotations: (k, 3, 3), columns are the box's axes; default aligned.
            radii: Rounding added to the core, (k,) or one number [m].
            velocities: Of the centres, (k, 3) [m/s]; default at rest.
            angular_velocities: World frame, (k, 3) [rad/s]; default none.
            worked: (k,) or one bool: whether the hand works on them.

        Raises:
            ValueError: More than the slots there are, or a half size not positive.
        """
        _check_positive("box half sizes", half_sizes)
        if rotations is None:
            rotations = jnp.tile(jnp.eye(3), (np.shape(centers)[0], 1, 1))
        return self.replace(
            boxes=_fill(
                self.boxes,
                center=centers,
                rotation=rotations,
                half_size=half_sizes,
                radius=radii,
                velocity=velocities,
                angular_velocity=angular_velocities,
                worked=worked,
            )
        )


def _check_positive(what: str, values) -> None:
    """Refuse concrete values that are not positive and finite; tracers pass."""
    if isinstance(values, jax.core.Tracer):
        return
    array = np.asarray(values, float)
    if not (np.all(np.isfinite(array)) and np.all(array > 0)):
        raise ValueError(f"{what} must be positive and finite, got {array.tolist()}")


def _fill(slots, **contents):
    """Write k obstacles into the first k slots and switch the rest off."""
    total = slots.active.shape[0]
    first = next(value for value in contents.values() if value is not None)
    k = np.shape(first)[0]
    if k > total:
        kind = type(slots).__name__.lower()
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
