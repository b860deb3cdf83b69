r"""A guard behind a controller: it takes a step only if the arm can stop after it.

The stop of a state (q, v) is the line $q + \sigma v$: all joints slow down together,
evenly, within the time T that the motors need. A torque passes if the stop after the
step that it leads to keeps clear of everything; else it is blended with that of the
stop which is already known to be clear. `docs/guard.md` has the proof and what it
assumes.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from rmp_mjx.control.avoidance import capsule_pairs, obstacle_gaps, segment_gap
from rmp_mjx.math import psd_solve
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.pytree import Constant, Pytree
from rmp_mjx.robot.bounds import Bounds, centre_levers, squares_of
from rmp_mjx.robot.dynamics import holding_torque
from rmp_mjx.robot.kinematics import (
    ArmState,
    Motion,
    motion_of,
    select,
)
from rmp_mjx.robot.model import Robot
from rmp_mjx.robot.point_state import point_carrier, point_state
from rmp_mjx.shapes import Planes
from rmp_mjx.vec import Vec

FADE = 0.5
"""A slow point that is inside the margin may approach by its distance in this time
[s]: it never arrives at a body at rest."""

STAGES = (0.2, 1.0)
"""Shares of the longest stop for which a stop is computed."""

ROUNDING = 1e-5
"""What a step must have to spare over what its stop needs [m], for float32."""

SLACK = 1e-3
"""Share of a torque by which rounding may break its limit: far below the reserve."""


class Scene(NamedTuple):
    """What one state gives to judge velocities u = a v + b w by; see `_judge`."""

    robot: Robot
    """The arm."""
    arm: ArmState
    """Its state; v is its velocity."""
    w: Float[Array, " n"]
    """The velocity after the step that the controller wants [rad/s]."""
    momenta: tuple[Array, Array]
    """Mq v and Mq w."""
    rest: Float[Array, " n"]
    """Torque that holds the arm at rest, contacts included [N m]."""
    levers: Float[Array, "n n"]
    """Of the links' centres of mass, see `centre_levers` [m]."""
    points: tuple[Vec, Vec]
    """Velocities of the control points at v and w, (p,) [m/s]."""
    spins: tuple[Vec, Vec]
    """Angular velocities of the links, (n,) [rad/s]."""
    rows: list[tuple[Array, tuple[Array, Array], Array, Array]]
    """For each kind of obstacle: distance (o, p) [m], its rates by the arm's motion at
    v and w [m/s], speed of the obstacles (o, 1) [m/s], and which count."""
    pairs: tuple[Array, tuple[Array, Array]] | None
    """For the link capsules, (2, k): distance and rates."""


class StopGuard(Pytree):
    r"""Passive safety: whatever touches the arm finds it slower than `speed`.

    With u the velocity after the next step, N the steps of the stop from there and
    $\sigma$ the way to its end on the line $q + \sigma u$, the guard asks of every
    distance d, to obstacles and between links,

    $$
    \min(d,\; d + \sigma\, \hat n \cdot J u - \tfrac12 \sigma^2 \kappa(u))
    - (N + 1) h\, v_{obstacle} \ge margin .
    $$

    It is a bound: distances to convex bodies are convex, and kappa bounds the curvature
    of the points' paths. A link inside the margin may move on more slowly than `speed`.
    Only the kinematics of the present state are needed. Make it by `StopGuard.of`.
    """

    bounds: Bounds
    """The arm's constants."""
    damping: Float[Constant, " n"]
    """Viscous damping of the joints, whether compensated or not [N m s/rad]."""
    step: Float[Constant, ""] | float = 0.005
    """Time between two calls h [s]."""
    speed: Float[Constant, ""] | float = 0.05
    """Speed u that a link may have at a contact [m/s]."""
    margin: Float[Constant, ""] | float = 0.001
    """Distance that is kept [m]."""
    limit_margin: Float[Constant, ""] | float = 0.105
    """Distance to a joint limit that is kept [rad]; below 0.1 is an event."""
    obstacle_speed: Float[Constant, ""] | float = 0.0
    """Spheres, capsules and boxes move at most this fast, or as fast as they are seen
    to if that is more [m/s]."""
    obstacle_error: Float[Constant, ""] | float = 0.0
    """Error of their positions [m]."""
    tolerance: Float[Constant, ""] | float = 1e-4
    """Error of the velocity that is predicted for the next step [rad/s]."""
    reserve: Float[Constant, ""] | float = 0.05
    """Share of the torque that a stop leaves unused."""
    longest: Float[Constant, ""] | float = 0.15
    """Longest stop [s]. More serves heavy or weak arms, but widens the bounds."""
    blends: tuple[float, ...] = struct.field(pytree_node=False, default=(1.0, 0.5, 0.2))
    """Shares of the controller's torque that are tried; the rest is the stop's."""
    leaving: bool = struct.field(pytree_node=False, default=False)
    """Whether a link inside the margin may be fast if it does not approach. The claim
    is then about the arm's own speed towards what touches it."""

    @classmethod
    def of(cls, robot: Robot, step: float = 0.005, **options: Any) -> StopGuard:
        """The guard of an arm.

        Args:
            robot: The arm.
            step: Control timestep [s].
            **options: The other fields.

        Raises:
            ValueError: A sliding joint has no limits.
        """
        damping, _ = robot.friction
        return cls(Bounds.of(robot), damping, step=step, **options)

    def __call__(
        self,
        robot: Robot,
        arm: ArmState,
        tau: Float[Array, " n"],
        Mq: Float[Array, "n n"],
        bias: Float[Array, " n"],
        obstacles: Obstacles,
        tau_ext: Float[Array, " n"] | None = None,
    ) -> tuple[Float[Array, " n"], dict[str, Array]]:
        """The torque that is sent, and what the guard did.

        Args:
            robot: The arm, with the torque limits that hold.
            arm: Its state.
            tau: The controller's torque, within the limits, (n,) [N m].
            Mq: Inertia, (n, n).
            bias: Bias forces of `dynamics`, (n,) [N m].
            obstacles: Obstacle slots.
            tau_ext: Joint torque of the contacts, (n,) [N m]; none if not given.

        Returns:
            Torque (n,) [N m] and diagnostics: `guard_used` in [0, 1], the stop's share
            of the torque; `guard_verified`, 1 where a stop after this step is proved;
            `guard_assumptions`, 1 where this state has no proved stop, which an
            assumption that fails explains; `guard_qd` (n,), the velocity that is
            expected at the next step [rad/s], see `kept`.
        """
        v, h = arm.qd, self.step
        damping = jnp.asarray(self.damping, v.dtype)
        known = 0.0 if robot.damping is None else jnp.asarray(robot.damping, v.dtype)
        ext = jnp.zeros_like(v) if tau_ext is None else jnp.asarray(tau_ext, v.dtype)

        # The plant: (Mq + h D) (v' - v) / h = tau - load.
        load = bias + (damping - known) * v - ext
        implicit = Mq + h * jnp.diag(damping)
        w = v + h * psd_solve(implicit, tau - load)
        scene = self._scene(robot, arm, w, Mq, ext, obstacles)
        T, _ = self._stop(scene, v, scene.momenta[0], 0.0)
        kept = jnp.maximum(1.0 - h / T, 0.0)
        brake = load - _dot(implicit, v) * ((1.0 - kept) / h)
        brake = jnp.clip(brake, -robot.tau_max, robot.tau_max)

        share = np.array(self.blends)
        a = jnp.concatenate([jnp.ones_like(T)[None], (1.0 - share) * kept])
        b = jnp.asarray(np.r_[0.0, share], v.dtype)
        lag = jnp.asarray(np.r_[0.0, np.ones(len(share))], v.dtype)
        proved = jax.vmap(functools.partial(self._judge, scene))(a, b, lag)
        stands, passes = proved[0], proved[1:]

        part = jnp.asarray(share, v.dtype)[jnp.argmax(passes)]
        part = jnp.where(jnp.any(passes), part, 0.0)
        sent = jnp.where(part == 1.0, tau, brake + part * (tau - brake))
        return jnp.where(part == 0.0, brake, sent), {
            "guard_used": 1.0 - part,
            "guard_verified": jnp.asarray((part > 0.0) | stands, v.dtype),
            "guard_assumptions": jnp.asarray(~stands, v.dtype),
            "guard_qd": (1.0 - part) * kept * v + part * w,
        }

    def kept(
        self, expected: Float[Array, " n"], qd: Float[Array, " n"]
    ) -> Bool[Array, ""]:
        """Whether the last step went as predicted: assumption (i) of the proof.

        Args:
            expected: `guard_qd` of the last step, (n,) [rad/s].
            qd: The velocity that came of it, (n,) [rad/s].
        """
        return jnp.all(jnp.abs(qd - expected) <= self.tolerance)

    def _scene(
        self,
        robot: Robot,
        arm: ArmState,
        w: Float[Array, " n"],
        Mq: Float[Array, "n n"],
        ext: Float[Array, " n"],
        obstacles: Obstacles,
    ) -> Scene:
        """Distances in this state, and how two velocities change them."""
        V = motion_of(robot, arm.S, w)
        points = point_state(robot, arm)
        at_w = select(V, point_carrier(robot)).at(points.x)
        gaps = obstacle_gaps(robot, points, obstacles)
        rows, scallop = [], jnp.asarray(self.bounds.scallop, arm.p.dtype)
        for kind, gap in zip(obstacles.kinds, gaps.values(), strict=True):
            rates = tuple(
                gap.normal @ x.map(lambda c: c[None]) for x in (points.v, at_w)
            )
            fastest, distance = kind.greatest_speed(), gap.distance - scallop[None]
            if not isinstance(kind, Planes):
                fastest = jnp.maximum(fastest, self.obstacle_speed)
                distance = distance - self.obstacle_error
            rows.append((distance, rates, fastest[:, None], gap.active))
        return Scene(
            robot=robot,
            arm=arm,
            w=w,
            momenta=(_dot(Mq, arm.qd), _dot(Mq, w)),
            rest=holding_torque(robot, arm) - ext,
            levers=centre_levers(robot, arm),
            points=(points.v, at_w),
            spins=(arm.V.ang, V.ang),
            rows=rows,
            pairs=_pairs(robot, arm, V),
        )

    def _stop(
        self, scene: Scene, u: Float[Array, " n"], Mu: Float[Array, " n"], lag: Any
    ) -> tuple[Float[Array, ""], Bool[Array, ""]]:
        r"""Time of the shortest stop, and whether the motors can do it.

        The torque on the line is $g(q) - M_q(q) u / T$ and Coriolis. Its values at the
        present q and bounds of their change give, for every joint, $|p| / T + B T
        \le C$. The bounds are for stops of some length; a few `STAGES` are tried.

        Args:
            scene: The state.
            u: Velocity at the start of the stop, (n,) [rad/s].
            Mu: Mq u, (n,).
            lag: 1 if the stop starts after a step from here, 0 if it starts here.
        """
        stages = self.longest * jnp.asarray(STAGES, u.dtype)
        within = functools.partial(self._stop_within, scene, u, Mu, lag)
        times, possible = jax.vmap(within)(stages)
        best = jnp.min(jnp.where(possible, times, jnp.inf))
        return jnp.minimum(best, times[-1]), jnp.any(possible)

    def _stop_within(
        self, scene: Scene, u: Array, Mu: Array, lag: Any, longest: Array
    ) -> tuple[Float[Array, ""], Bool[Array, ""]]:
        """The same with bounds for stops of at most `longest` [s]."""
        dtype, size, ahead = u.dtype, jnp.abs(u), lag * self.step
        tau_max = jnp.asarray(scene.robot.tau_max, dtype)
        R = self.bounds.levers(scene.levers, u, longest + ahead)
        coriolis, inertia, load = self.bounds.torques(scene.robot, R, u)
        unused = 0.5 * self.reserve * (1.0 + lag)
        room = (1.0 - unused) * tau_max - jnp.asarray(self.damping, dtype) * size
        room = room - coriolis - 0.5 * inertia - ahead * load
        need = jnp.abs(Mu) + ahead * inertia
        C, B = room + jnp.sign(Mu) * scene.rest, 0.5 * load
        root = C * C - 4.0 * B * need
        fits = (C > 0.0) & (root >= 0.0)
        shortest = 2.0 * need / (C + jnp.sqrt(jnp.where(fits, root, 1.0)))
        T = jnp.maximum(jnp.max(jnp.where(fits, shortest, longest)), self.step)
        left = room - T * B + SLACK * tau_max
        moving = jnp.abs(scene.rest - Mu / T) + ahead * inertia / T <= left
        fits &= longest >= T
        return T, jnp.all(fits & moving & (jnp.abs(scene.rest) <= left))

    def _judge(self, scene: Scene, a: Array, b: Array, lag: Array) -> Bool[Array, ""]:
        """Whether the stop from the velocity u = a v + b w keeps clear.

        Args:
            scene: The state.
            a: Share of the present velocity.
            b: Share of the wanted one.
            lag: 1 if the stop starts after a step with u, 0 if it starts here.
        """
        bounds, robot, arm = self.bounds, scene.robot, scene.arm

        def mix(both: tuple[Array, Array]) -> Array:
            return a * both[0] + b * both[1]

        def mix_vec(both: tuple[Vec, Vec]) -> Vec:
            return both[0] * a + both[1] * b

        u = mix((arm.qd, scene.w))
        T, good = self._stop(scene, u, mix(scene.momenta), lag)
        # The velocities of the stop are u (1 - k h / T), k = 0, 1, ... < rests.
        h, rests = self.step, jnp.ceil(T / self.step - 1e-3)
        way = lag * h + h * (rests - 1.0) * (1.0 - rests * h / (2.0 * T))
        size, squares = squares_of(u)
        steps, margin = rests + lag, self.margin + ROUNDING * lag

        def loss(squares_bound: Constant, lever: Constant) -> tuple[Array, Array]:
            """What curvature and errors of prediction do to distances and speeds."""
            bend = _dot(squares, squares_bound)
            error = self.tolerance * steps * jnp.sum(jnp.asarray(lever), axis=1)
            return way * (0.5 * way * bend + error), way * bend + error

        def clear(d: Array, rate: Array, slip: Array, gain: Array, speed: Array):
            """Which distances keep the margin, or belong to what is slow enough."""
            keeps = jnp.minimum(d, d + way * rate - slip) >= margin
            leaves = rate - gain >= -self.speed if self.leaving else False
            slow = (speed + gain <= self.speed) | leaves
            gentle = (rate >= -jnp.maximum(d, 0.0) / FADE) | (lag == 0.0)
            return keeps | (slow & gentle)

        spin = _length(mix_vec(scene.spins))
        links = jnp.stack([*loss(bounds.bend, bounds.lever), spin])
        slip, gain, spin = _dot(links, point_carrier(robot))[:, None, :]
        rho = jnp.asarray(robot.points.radius, u.dtype)
        speed = _length(mix_vec(scene.points))[None] + rho[None] * spin
        for distance, rates, fastest, active in scene.rows:
            left = distance - steps * h * fastest
            good &= jnp.all(clear(left, mix(rates), slip, gain, speed) | ~active)
        if scene.pairs is not None:
            distance, rates = scene.pairs
            slip, gain = (x[None] for x in loss(bounds.pair_bend, bounds.pair_lever))
            speed = _dot(jnp.asarray(bounds.pair_lever, u.dtype), size)[None]
            good &= jnp.all(clear(distance, mix(rates), slip, gain, speed))
        end, aside = arm.q + way * u, self.limit_margin + ROUNDING * lag
        good &= jnp.all((end - robot.q_lower >= aside) | (u >= -self.tolerance))
        return good & jnp.all((robot.q_upper - end >= aside) | (u <= self.tolerance))


def _pairs(
    robot: Robot, arm: ArmState, V: Motion
) -> tuple[Array, tuple[Array, Array]] | None:
    """Distances of the far capsules' ends to the plane that touches the near capsule.

    The plane is across the line of least distance; the lesser of the two ends'
    distances to it, less both radii, is a bound of the distance however the far
    capsule moves.

    Returns:
        Distances (2, k) and their rates at the arm's velocity and at the twists V.
    """
    if not robot.capsules.pairs:
        return None
    pairs = capsule_pairs(robot, arm)
    x = pairs.ends
    g, _, norm = segment_gap(x)
    normal = g.map(lambda c: (c / norm)[None])
    x = x.map(lambda c: c.reshape(4, -1))
    along = normal @ x
    distance = along[:2] - (jnp.max(along[2:], axis=0) + pairs.reach)[None]
    tips = x.map(lambda c: c[:2])
    rates = []
    for motion in (arm.V, V):
        relative = select(motion, pairs.relative)
        relative = Motion(
            *(part.map(lambda c: c[None]) for part in (relative.lin, relative.ang))
        )
        rates.append(normal @ relative.at(tips))
    return distance, (rates[0], rates[1])


def _length(v: Vec) -> Array:
    return jnp.sqrt(v @ v)


def _dot(a: Array, b: Constant) -> Array:
    return jnp.matmul(a, jnp.asarray(b, a.dtype), precision="highest")
