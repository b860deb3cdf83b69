r"""Shapes of obstacles in padded slots, and their distance to control points.

Every curved obstacle is a core (point, segment, box) inflated by a radius. With
$g$ the vector from the nearest core point and $\dot g$ its rate,

$$
d = |g| - r, \quad \hat n = g / |g|, \quad \dot d = \hat n \cdot \dot g, \quad
\ddot d = \hat n \cdot \ddot x + c, \quad
c = \hat n \cdot b + (|\dot g|^2 - \dot d^2) / |g|
$$

where $\ddot x$ is the control point's acceleration and b the Coriolis and
centripetal terms of a rotating obstacle. The gradient is a unit normal everywhere.
"""

from __future__ import annotations

import abc
import functools
import operator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from rmp_mjx.math import LARGEST, is_rotation, is_unit
from rmp_mjx.pytree import Constant, Pytree
from rmp_mjx.vec import Vec, xyz

TINY = 1e-9
"""Core distances below this [m] count as the core itself: the normal is arbitrary."""


class Gap(NamedTuple):
    """Distance of every control point to every obstacle of one kind, (o, p) each."""

    distance: Array
    """Signed distance between surfaces [m]."""
    rate: Array
    """Its rate of change, both motions included [m/s]."""
    normal: Vec
    """Unit gradient of the distance with respect to the control point."""
    curvature: Array
    """The part of the distance's acceleration that is not normal . xdd [m/s^2]."""
    active: Array
    """Whether the control point avoids the obstacle."""


class Shape(Pytree, abc.ABC):
    """Obstacles of one kind: o slots, of which some are in use."""

    velocity: Float[Constant, "o 3"]
    """Velocity of the centre, of a plane that of its surface [m/s]."""
    hand_may_touch: Bool[Constant, " o"]
    """Whether the hand may touch it. All other links still avoid it."""
    active: Bool[Constant, " o"]
    """Whether the slot is in use."""

    @abc.abstractmethod
    def gap(
        self, x: Vec, v: Vec, rho: Float[Constant, "1 p"], hand: Bool[np.ndarray, " p"]
    ) -> Gap:
        """Distance of every control point to every obstacle; see `Obstacles.gaps`.

        Positions x and velocities v are (1, p) each.
        """

    def sound(self) -> Bool[Array, " o"]:
        """Which slots hold numbers that mean an obstacle, (o,), in use or not."""
        fields = [jnp.asarray(x) for x in vars(self).values()]
        sizes = [jnp.abs(x) for x in fields if x.dtype != bool]
        small = [jnp.all(x <= LARGEST, axis=range(1, x.ndim)) for x in sizes]
        return functools.reduce(operator.and_, small)

    def greatest_speed(self) -> Float[Array, " o"]:
        """Greatest speed of any point of each obstacle's core, (o,) [m/s]."""
        return _norm(self.velocity)

    def _avoided(self, hand: Bool[np.ndarray, " p"]) -> Bool[Array, "o p"]:
        """Which control points avoid which obstacles."""
        exempt = self.hand_may_touch[:, None] & hand[None]
        return jnp.asarray(self.active)[:, None] & ~exempt


class Rounded(Shape):
    """Bodies with a centre and a radius."""

    center: Float[Constant, "o 3"]
    """Centre, world frame [m]."""
    radius: Float[Constant, " o"]
    """Radius of the rounding [m]; it comes on top of the core."""

    def sound(self) -> Bool[Array, " o"]:
        """Which slots hold numbers that mean an obstacle, (o,)."""
        return super().sound() & (self.radius >= 0.0)


class Turning(Rounded):
    """Rounded bodies that may turn."""

    angular_velocity: Float[Constant, "o 3"]
    """Angular velocity, world frame [rad/s]."""

    def _ride_along(self, x: Vec, v: Vec) -> tuple[Vec, Vec, Vec]:
        """Position, velocity and Coriolis acceleration in the moving frame."""
        omega = Vec.column(self.angular_velocity)
        r = x - Vec.column(self.center)
        rdot = v - Vec.column(self.velocity)
        swept = omega.cross(r)
        coriolis = omega.cross(swept) - omega.cross(rdot) * 2.0
        return r, rdot - swept, coriolis


class Spheres(Rounded):
    """Balls: the core is a point."""

    def gap(
        self, x: Vec, v: Vec, rho: Float[Constant, "1 p"], hand: Bool[np.ndarray, " p"]
    ) -> Gap:
        """Distances, rates, normals and curvatures, (o, p) each."""
        g = x - Vec.column(self.center)
        gdot = v - Vec.column(self.velocity)
        return _inflate(g, gdot, self.radius[:, None] + rho, self._avoided(hand))


class Planes(Shape):
    """Half-spaces."""

    point: Float[Constant, "o 3"]
    """A point on the surface, world frame [m]."""
    normal: Float[Constant, "o 3"]
    """Unit normal that points out of the obstacle."""

    def sound(self) -> Bool[Array, " o"]:
        """Which slots hold numbers that mean an obstacle, (o,)."""
        return super().sound() & is_unit(self.normal)

    def gap(
        self, x: Vec, v: Vec, rho: Float[Constant, "1 p"], hand: Bool[np.ndarray, " p"]
    ) -> Gap:
        """Distances, rates, normals and curvatures, (o, p) each."""
        n = Vec.column(self.normal)
        distance = n @ (x - Vec.column(self.point)) - rho
        rate = n @ (v - Vec.column(self.velocity))
        return Gap(distance, rate, n, jnp.zeros_like(rate), self._avoided(hand))


class Capsules(Turning):
    """Segments inflated by a radius."""

    axis: Float[Constant, "o 3"]
    """Unit vector along the segment."""
    half_length: Float[Constant, " o"]
    """Half the segment's length [m]."""

    def sound(self) -> Bool[Array, " o"]:
        """Which slots hold numbers that mean an obstacle, (o,)."""
        return super().sound() & (self.half_length >= 0.0) & is_unit(self.axis)

    def greatest_speed(self) -> Float[Array, " o"]:
        """Greatest speed of any point of each segment, (o,) [m/s]."""
        return _norm(self.velocity) + _norm(self.angular_velocity) * self.half_length

    def gap(
        self, x: Vec, v: Vec, rho: Float[Constant, "1 p"], hand: Bool[np.ndarray, " p"]
    ) -> Gap:
        """Distances, rates, normals and curvatures, (o, p) each."""
        axis, half = Vec.column(self.axis), self.half_length[:, None]
        r, rel, coriolis = self._ride_along(x, v)
        along = axis @ r
        free = jnp.abs(along) >= half
        g = r - axis * jnp.clip(along, -half, half)
        gdot = rel - axis * jnp.where(free, 0.0, axis @ rel)
        radius = self.radius[:, None] + rho
        return _inflate(g, gdot, radius, self._avoided(hand), coriolis)


class Boxes(Turning):
    """Boxes with rounded edges: a box core inflated by a radius."""

    rotation: Float[Constant, "o 3 3"]
    """Orientation (columns are the box's axes)."""
    half_size: Float[Constant, "o 3"]
    """Half sizes of the core [m]."""

    def sound(self) -> Bool[Array, " o"]:
        """Which slots hold numbers that mean an obstacle, (o,)."""
        size = jnp.all(jnp.asarray(self.half_size) >= 0.0, axis=-1)
        return super().sound() & size & is_rotation(self.rotation)

    def greatest_speed(self) -> Float[Array, " o"]:
        """Greatest speed of any point of each core, (o,) [m/s]."""
        spin = _norm(self.angular_velocity) * _norm(self.half_size)
        return _norm(self.velocity) + spin

    def gap(
        self, x: Vec, v: Vec, rho: Float[Constant, "1 p"], hand: Bool[np.ndarray, " p"]
    ) -> Gap:
        """Distances, rates, normals and curvatures, (o, p) each.

        Inside the core the distance is minus the depth below the nearest face.
        """
        axes = [Vec.column(self.rotation[:, :, i]) for i in range(3)]
        half = Vec.column(self.half_size)
        r, rel, coriolis = self._ride_along(x, v)
        local, local_v, local_c = (
            Vec(*(a @ w for a in axes)) for w in (r, rel, coriolis)
        )
        over = local.map(lambda c, h: jnp.abs(c) - h, half)
        depth = jnp.maximum(jnp.maximum(over.x, over.y), over.z)
        inside = depth <= 0.0
        # Outside, g is what exceeds the core; inside, the normal of the nearest face.
        x_face = over.x >= depth
        y_face = (over.y >= depth) & ~x_face
        face = Vec(x_face, y_face, ~(x_face | y_face))
        free = face.map(lambda f, o: jnp.where(inside, f, o > 0.0), over)
        reach = over.map(lambda o: jnp.where(inside, 1.0, o))
        sign = local.map(lambda c: jnp.where(c < 0.0, -1.0, 1.0))
        local_g = free.map(lambda f, s, o: jnp.where(f, s * o, 0.0), sign, reach)
        local_gdot = free.map(lambda f, c: jnp.where(f, c, 0.0), local_v)
        radius = self.radius[:, None] + rho
        gap = _inflate(local_g, local_gdot, radius, self._avoided(hand), local_c)
        n = gap.normal
        return gap._replace(
            normal=axes[0] * n.x + axes[1] * n.y + axes[2] * n.z,
            distance=jnp.where(inside, depth - radius, gap.distance),
        )


def _norm(x: Constant) -> Array:
    return jnp.sqrt(jnp.sum(jnp.asarray(x) ** 2, axis=-1))


def _inflate(
    g: Vec, gdot: Vec, radius: Array, active: Array, coriolis: Vec | None = None
) -> Gap:
    """Gap to a core inflated by a radius, from the vector off the core and its rate.

    Normal, rate and curvature end in divisions, which XLA stores: see `Barrier.scalar`.
    """
    touching = g @ g <= TINY**2
    g = Vec(
        *(jnp.where(touching, up, c) for up, c in zip((0, 0, 1), xyz(g), strict=True))
    )
    norm = jnp.sqrt(g @ g)
    normal = Vec(g.x / norm, g.y / norm, g.z / norm)
    rate = (g @ gdot) / norm
    turning = jnp.where(touching, 0.0, gdot @ gdot - rate * rate)
    if coriolis is not None:
        turning = turning + g @ coriolis
    distance = jnp.where(touching, 0.0, norm) - radius
    return Gap(distance, rate, normal, turning / norm, active)


KINDS: dict[type[Shape], str] = {
    Spheres: "spheres",
    Planes: "planes",
    Capsules: "capsules",
    Boxes: "boxes",
}
"""Kinds of obstacles by name."""
