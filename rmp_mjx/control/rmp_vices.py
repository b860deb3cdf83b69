"""RMP-VICES: the impedance target fused with avoidance over the whole arm."""

from __future__ import annotations

import functools
import operator
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, ArrayLike, Float

from rmp_mjx.control.arguments import check_obstacles, check_setpoint, check_state
from rmp_mjx.control.avoidance import obstacle_branch, self_branch
from rmp_mjx.control.controller import ImpedanceController
from rmp_mjx.control.dither import SetpointDither
from rmp_mjx.control.leaves import CollisionLeaf, Leaves
from rmp_mjx.control.relaxation import OrientationRelaxation, joint_limit_relaxation
from rmp_mjx.control.torque import clip_torque, torque_range
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.pytree import Constant
from rmp_mjx.rmp import RMP, pullback, resolve
from rmp_mjx.rmp.leaves.attractor import PositionAttractor, orientation_attractor
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import ArmState, SiteState, arm_state, site_state
from rmp_mjx.types import ControlOutput, Setpoint
from rmp_mjx.xla import materialize

_DEFAULT: Any = None  # stands for leaves that depend on the robot


class RMPVICES(ImpedanceController):
    r"""Variable-impedance control as the attractor of an RMP-tree (paper, section III).

    One call evaluates the tree at (q, qd), resolves its root in the inertia metric and
    turns the acceleration into torque:

    $$
    (M + \epsilon M_q)\, \ddot q = f, \qquad \tau = b + k\, M_q \ddot q .
    $$

    The inertia-weighted regulariser makes the tree without its safety leaves converge
    to (coupled) operational-space control as $\epsilon \to 0$; the paper's
    Moore-Penrose inverse does not. The controller is a pytree: gains and leaf
    parameters are array leaves that can be traced, vmapped, differentiated and tuned.
    """

    leaves: Leaves = struct.field(default=_DEFAULT)
    """The safety leaves and the posture; `Leaves.default(robot)` if not given."""
    attractor_weight: Float[Constant, ""] | float = 1.0
    """Metric of the two impedance attractors."""
    obstacle_relaxation: OrientationRelaxation | None = struct.field(
        default_factory=OrientationRelaxation
    )
    """Weight of the orientation attractor beside spheres, capsules and boxes. Planes do
    not count: the hand cannot turn past a plane. None: always 1."""
    limit_relaxation: OrientationRelaxation | None = struct.field(
        default_factory=joint_limit_relaxation
    )
    """Weight of the orientation attractor near a joint limit, so that a hand that can
    turn no further still moves on. The lesser of the two weights counts."""
    dither: SetpointDither | None = struct.field(default_factory=SetpointDither)
    """Motion of the set-point that frees a hand at rest beside such an obstacle."""
    regularizer: Float[Constant, ""] | float = 1e-3
    """The root's epsilon: damps accelerations that no leaf determines."""

    def __post_init__(self):
        """Fill in the default leaves, which depend on the robot."""
        if self.leaves is None:
            object.__setattr__(self, "leaves", Leaves.default(self.robot))

    def with_collision(self, collision: CollisionLeaf | None) -> RMPVICES:
        """The same controller with another collision leaf; see `Leaves`."""
        return self.replace(leaves=self.leaves.with_collision(collision))

    def __call__(
        self,
        q: Float[ArrayLike, " n"],
        qd: Float[ArrayLike, " n"],
        setpoint: Setpoint,
        obstacles: Obstacles,
        tau_ext: Float[ArrayLike, " n"] | None = None,
        tau_last: Float[ArrayLike, " n"] | None = None,
    ) -> ControlOutput:
        """Torque for one state.

        Args:
            q: Joint positions, (n,) [rad].
            qd: Joint velocities, (n,) [rad/s].
            setpoint: Impedance target, from `setpoint`.
            obstacles: Padded obstacle slots.

        Returns:
            Torque, acceleration, root RMP and diagnostics: `torque_scale` in [0, 1],
            `clearance` [m], the least distance of a control point to an obstacle, and
            `orientation_weight` in [0, 1], the relaxed weight of the orientation.

        Raises:
            ValueError: An argument has a wrong shape or dtype.
        """
        check_state(self.robot.n, q, qd, tau_ext, tau_last)
        check_setpoint(setpoint)
        check_obstacles(obstacles)
        q, qd = jnp.asarray(q), jnp.asarray(qd)
        arm = arm_state(self.robot, q, qd)
        Mq, bias = dynamics(self.robot, arm)
        branches, clearance, body_clearance = self._avoidance(arm, obstacles)
        orientation_weight = self._orientation_weight(q, body_clearance)
        site = site_state(self.robot, arm)
        if self.dither is not None:
            moved = self.dither(setpoint.time, body_clearance, site.v)
            setpoint = setpoint.replace(p_des=setpoint.p_des + moved)
        branches += self._impedance(site, setpoint, orientation_weight)
        if self.leaves.joint_limit is not None:
            branches.append(self.leaves.joint_limit(q, qd))
        if self.leaves.posture is not None:
            branches.append(self.leaves.posture(q, qd, Mq))
        root = jax.tree.map(materialize, functools.reduce(operator.add, branches))
        qdd = resolve(root, self.regularizer * Mq)
        dynamic = jnp.matmul(Mq, qdd, precision="highest")
        low, high = torque_range(self.robot, tau_last, self.period)
        tau, limit = clip_torque(dynamic + bias, low, high)
        return ControlOutput(
            tau=tau,
            qdd=qdd,
            f=root.f,
            M=root.M,
            Mq=Mq,
            bias=bias,
            diagnostics={
                "torque_limit": limit,
                "clearance": clearance,
                "orientation_weight": orientation_weight,
            },
        )

    def _impedance(
        self, site: SiteState, setpoint: Setpoint, orientation_weight: Float[Array, ""]
    ) -> list[RMP]:
        """The two attractors of the end effector, pulled back to the joints."""
        weight = self.attractor_weight
        position = PositionAttractor(setpoint.p_des, setpoint.kp_pos, weight=weight)
        orientation = orientation_attractor(
            site.R,
            site.w,
            setpoint.R_des,
            setpoint.kp_ori,
            weight=weight * orientation_weight,
        )
        return [
            pullback(position(site.p, site.v), site.J_pos, site.Jdot_qd_pos),
            pullback(orientation, site.J_ori, site.Jdot_qd_ori),
        ]

    def _avoidance(
        self, arm: ArmState, obstacles: Obstacles
    ) -> tuple[list[RMP], Float[Array, ""], Float[Array, ""]]:
        """Collision RMPs on the joints, the least clearance, and that without planes.

        Clearances are in m, and infinite if there is no obstacle.
        """
        branches, nearest = [], {}
        if self.leaves.collision is not None:
            rmp, nearest = obstacle_branch(
                self.robot, arm, obstacles, self.leaves.collision
            )
            branches.append(rmp)
        if self.leaves.self_collision is not None:
            branches.append(self_branch(self.robot, arm, self.leaves.self_collision))
        infinite = jnp.array(jnp.inf, arm.p.dtype)
        bodies = [d for kind, d in nearest.items() if kind != "planes"]
        clearance, body_clearance = (
            functools.reduce(jnp.minimum, distances, infinite)
            for distances in (nearest.values(), bodies)
        )
        return branches, clearance, body_clearance

    def _orientation_weight(
        self, q: Float[Array, " n"], body_clearance: Float[Array, ""]
    ) -> Float[Array, ""]:
        """Weight of the orientation: the lesser of the two relaxations."""
        weight = jnp.ones_like(body_clearance)
        if self.obstacle_relaxation is not None:
            weight = jnp.minimum(weight, self.obstacle_relaxation(body_clearance))
        if self.limit_relaxation is not None:
            room = jnp.minimum(q - self.robot.q_lower, self.robot.q_upper - q)
            weight = jnp.minimum(weight, self.limit_relaxation(jnp.min(room)))
        return weight
