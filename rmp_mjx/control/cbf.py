"""VICES behind a safety filter: a quadratic program with control-barrier functions."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rmp_mjx.control.avoidance import obstacle_gaps, self_gaps
from rmp_mjx.control.torque import clip_torque, torque_range
from rmp_mjx.control.vices import VICES
from rmp_mjx.math import inverse_root, psd_solve
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.pytree import Constant
from rmp_mjx.robot.kinematics import ArmState
from rmp_mjx.robot.model import Robot
from rmp_mjx.robot.point_state import point_state
from rmp_mjx.types import ControlOutput, Setpoint

LARGEST = 300.0
"""Largest change that one barrier can demand [sqrt(kg m^2) rad/s^2]."""
KEPT = 48
"""Constraints of the program: those with the least room. The others are checked after
the solution."""
FREE = 1e-3
"""Rows shorter than this are left out: no joint changes that distance."""


class Barriers(NamedTuple):
    """Distances that must stay positive, with d'' = row . qdd + drift; m of them."""

    distance: Float[Array, " m"]
    """Beyond the margin [m or rad]."""
    rate: Float[Array, " m"]
    """Its rate."""
    drift: Float[Array, " m"]
    """Its acceleration while qdd = 0."""
    rows: Float[Array, "m n"]
    """Its gradient."""
    active: Bool[Array, " m"]
    """Whether the barrier is in use."""


class FilteredVICES(VICES):
    r"""VICES with the smallest change of its acceleration that keeps the barriers.

    $$
    \min_{\ddot q} \|\ddot q - \ddot q_{VICES}\|^2_{M_q}
    \quad \text{s.t.} \quad
    \ddot d_i + 2 \alpha \dot d_i + \alpha^2 d_i \ge 0, \quad
    |M_q \ddot q + b| \le \tau_{max}
    $$

    with a barrier on the distance of every control point to every obstacle, of the
    links' capsules to each other, and of every joint to its limits: the same points,
    obstacles and margins as `RMPVICES`. They have relative degree 2; the gains put both
    poles at $-\alpha$, so that a distance decays without overshoot. If not all can
    hold, a violation costs its square (see `project`). The torque is clipped in the
    end.

    Source: Nguyen and Sreenath, "Exponential control barrier functions" (2016); Khazoom
    et al., "Humanoid self-collision avoidance using whole-body control with control
    barrier functions" (2022).
    """

    rate: Float[Constant, ""] | float = 10.0
    """Rate alpha at which a distance may shrink [1/s]."""
    margin: Float[Constant, ""] | float = 0.005
    """Minimum distance [m]."""
    limit_margin: Float[Constant, ""] | float = 0.12
    """Minimum distance to a joint limit [rad]."""
    penalty: Float[Constant, ""] | float = 1e3
    """Cost of a squared violation over that of a squared change."""

    def unguarded(
        self,
        arm: ArmState,
        setpoint: Setpoint,
        obstacles: Obstacles,
        tau_ext: Float[Array, " n"] | None,
        tau_last: Float[Array, " n"] | None,
    ) -> ControlOutput:
        """Torque for one state.

        Returns:
            As `VICES`; diagnostics also has `solved`, 1 where the program converged and
            the constraints that it leaves out hold.
        """
        out = super().unguarded(arm, setpoint, obstacles, tau_ext, tau_last)
        Mq, bias = out.Mq, out.bias
        wanted = psd_solve(Mq, out.tau - bias)
        barriers = self.barriers(arm, arm.q, arm.qd, obstacles)
        qdd, solved = self._filter(wanted, barriers, Mq, bias)
        dynamic = jnp.matmul(Mq, qdd, precision="highest")
        low, high = torque_range(self.robot, tau_last, self.period)
        tau, limit = clip_torque(dynamic + bias, low, high)
        return out.replace(
            tau=tau,
            qdd=qdd,
            f=dynamic,
            diagnostics={"torque_limit": limit, "solved": solved},
        )

    def barriers(
        self,
        arm: ArmState,
        q: Float[Array, " n"],
        qd: Float[Array, " n"],
        obstacles: Obstacles,
    ) -> Barriers:
        """All distances beyond their margins, in the state q, qd."""
        kinds = [_points(self.robot, arm, obstacles), _links(self.robot, arm)]
        found = [_beyond(kind, self.margin) for kind in kinds if kind is not None]
        found.append(_beyond(_joints(self.robot, q, qd), self.limit_margin))
        return Barriers(*(jnp.concatenate(x) for x in zip(*found, strict=True)))

    def _filter(
        self,
        wanted: Float[Array, " n"],
        barriers: Barriers,
        Mq: Float[Array, "n n"],
        bias: Float[Array, " n"],
    ) -> tuple[Float[Array, " n"], Float[Array, ""]]:
        """The nearest admissible acceleration, and whether it was found.

        The program's variable is the change in the inertia's norm, and its rows have
        length 1.
        """
        need = (
            barriers.drift
            + 2.0 * self.rate * barriers.rate
            + self.rate**2 * barriers.distance
        )
        tau_max = jnp.asarray(self.robot.tau_max, Mq.dtype)
        G = jnp.concatenate([-barriers.rows, Mq, -Mq])
        h = jnp.concatenate([need, tau_max - bias, tau_max + bias]) - G @ wanted
        limits = jnp.ones(2 * self.robot.n, bool)
        R = inverse_root(Mq)
        G = jnp.matmul(R, G.T, precision="highest")
        length = jnp.sqrt(jnp.sum(G * G, axis=0))
        active = jnp.concatenate([barriers.active, limits]) & (length > FREE)
        scale = jnp.where(active, 1.0 / jnp.where(active, length, 1.0), 0.0)
        G = G * scale[None]
        h = jnp.where(active, jnp.clip(h * scale, -LARGEST, LARGEST), LARGEST)
        _, kept = jax.lax.top_k(-h, min(KEPT, len(h)))
        change, solved = project(G[:, kept], h[kept], self.penalty)
        left_out = h > h[kept[-1]]
        solved *= ~jnp.any(left_out & (change @ G > h))
        return wanted + jnp.matmul(R.T, change, precision="highest"), solved


def _beyond(barriers: Barriers, margin: Array | float) -> Barriers:
    return barriers._replace(distance=barriers.distance - margin)


def _points(robot: Robot, arm: ArmState, obstacles: Obstacles) -> Barriers | None:
    """Barriers between every control point and every obstacle."""
    if not obstacles.kinds or not robot.points.segment:
        return None
    points = point_state(robot, arm)
    segment = np.array(robot.points.segment, int)
    moves = np.arange(robot.n)[:, None] <= segment
    spin, shift = (v.map(lambda c: c[:, None]) for v in (arm.S.ang, arm.S.lin))
    x, a = (v.map(lambda c: c[None]) for v in (points.x, points.a))
    J = (shift + spin.cross(x)).map(lambda c: jnp.where(moves, c, 0.0)[None])
    found = []
    for gap in obstacle_gaps(robot, points, obstacles).values():
        normal = gap.normal.map(lambda c, d=gap.distance: jnp.broadcast_to(c, d.shape))
        rows = normal.map(lambda c: c[:, None]) @ J
        found.append(
            Barriers(
                gap.distance.ravel(),
                gap.rate.ravel(),
                (gap.curvature + normal @ a).ravel(),
                rows.swapaxes(1, 2).reshape(-1, robot.n),
                gap.active.ravel(),
            )
        )
    return Barriers(*(jnp.concatenate(x) for x in zip(*found, strict=True)))


def _links(robot: Robot, arm: ArmState) -> Barriers | None:
    """Barriers between the links' capsules that can touch."""
    if not robot.capsules.pairs:
        return None
    distance, rate, curvature, rows = self_gaps(robot, arm)
    return Barriers(distance, rate, curvature, rows, jnp.ones_like(rate, bool))


def _joints(robot: Robot, q: Float[Array, " n"], qd: Float[Array, " n"]) -> Barriers:
    """Barriers between every joint and its limits."""
    room = jnp.concatenate([q - robot.q_lower, robot.q_upper - q])
    limited = jnp.isfinite(room)
    eye = jnp.eye(robot.n, dtype=room.dtype)
    return Barriers(
        jnp.where(limited, room, 0.0),
        jnp.concatenate([qd, -qd]),
        jnp.zeros_like(room),
        jnp.concatenate([eye, -eye]),
        limited,
    )


STEPS = tuple(0.5**k for k in range(8))
"""Trial lengths of a Newton step."""
TOLERANCE, ITERATIONS = 3e-3, 20
"""Step length at which the solver stops, in units of x, and its iteration limit."""


def project(
    G: Float[Array, "n m"],
    h: Float[Array, " m"],
    penalty: Float[Array, ""] | float,
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    r"""The quadratic program of a projection, with a penalty for its constraints.

    $$
    \min_x \tfrac12 \|x\|^2 + \tfrac{\rho}{2} \sum_j \max(0, g_j \cdot x - h_j)^2
    $$

    by Newton's method: the Hessian is $I + \rho \sum g_j g_j^T$ over the
    violated constraints, and the best of `STEPS` along the step makes it descend. The
    cost is strictly convex and quadratic in pieces, of which the method visits a few.

    Args:
        G: Constraints as columns g_j.
        h: Their bounds.
        penalty: The cost rho.

    Returns:
        x, and 1 where the method converged, else 0.

    Source: Pinar and Zenios, "On smoothing exact penalty functions for convex
    constrained optimization" (1994); Hintermueller, Ito and Kunisch, "The primal-dual
    active set strategy as a semismooth Newton method" (2002).
    """
    eye = jnp.eye(len(G), dtype=G.dtype)

    def newton(state):
        x, _, count = state
        over = x @ G - h
        violated = jnp.where(over[None] > 0.0, G, 0.0)
        gradient = x + penalty * (G @ jnp.maximum(over, 0.0))
        step = -psd_solve(eye + penalty * violated @ G.T, gradient)
        rise = step @ G
        costs = [
            jnp.sum((x + t * step) ** 2)
            + penalty * jnp.sum(jnp.maximum(over + t * rise, 0.0) ** 2)
            for t in STEPS
        ]
        step *= jnp.array(STEPS, G.dtype)[jnp.argmin(jnp.array(costs))]
        return x + step, jnp.max(jnp.abs(step)), count + 1

    def goes_on(state):
        _, moved, count = state
        return (moved > TOLERANCE) & (count < ITERATIONS)

    start = (jnp.zeros(len(G), G.dtype), jnp.array(jnp.inf, G.dtype), 0)
    x, moved, _ = jax.lax.while_loop(goes_on, newton, start)
    return x, jnp.asarray(moved <= TOLERANCE, G.dtype)
