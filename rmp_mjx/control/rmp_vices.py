"""RMP-VICES: the impedance target fused with avoidance over the whole arm."""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from rmp_mjx.control.action import ActionRange, compose_setpoint
from rmp_mjx.control.avoidance import obstacle_branch, self_branch
from rmp_mjx.control.stirring import Stirring
from rmp_mjx.control.torque import scale_torque
from rmp_mjx.control.tree import rmp_vices_tree
from rmp_mjx.control.yielding import Yielding, limit_yielding
from rmp_mjx.names import unknown
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.pytree import Pytree
from rmp_mjx.rmp import RMP, ScalarLeaf, evaluate, pullback, resolve
from rmp_mjx.rmp.leaves.attractor import PositionAttractor, orientation_attractor
from rmp_mjx.rmp.leaves.collision import collision_near
from rmp_mjx.rmp.leaves.joint_limit import JointLimitBarrier
from rmp_mjx.rmp.leaves.posture import Posture
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import (
    ArmState,
    SiteState,
    arm_state,
    site_pose,
    site_state,
)
from rmp_mjx.robot.model import Robot
from rmp_mjx.shapes import KINDS
from rmp_mjx.types import Action, ControlOutput, Setpoint
from rmp_mjx.xla import materialize


class RMPVICES(Pytree):
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

    Leave a branch out of the tree with `None`; leave it at `...` for the default.
    """

    robot: Robot
    """The arm."""
    collision: ScalarLeaf | Mapping[str, ScalarLeaf | None] | Any | None = ...
    """Leaf between every control point and obstacle, or one for each kind: `spheres`,
    `planes`, `capsules`, `boxes` (None: not avoided; left out: the default). Parameters
    may be arrays that broadcast against (obstacles, points): see `per_link`."""
    self_collision: ScalarLeaf | Any | None = ...
    """Leaf between the link capsules that can touch."""
    joint_limit: ScalarLeaf | Any | None = ...
    """Leaf on the joints."""
    posture: Posture | Any | None = ...
    """Rest configuration, in the inertia metric: fills the null space. The default's
    spring is soft, so that the hand can turn past obstacles, and overdamped."""
    attractor_weight: Float[Array, ""] | float = 1.0
    """Metric of the two impedance attractors."""
    yielding: Yielding | Any | None = ...
    """Weight of the orientation attractor beside spheres, capsules and boxes; a plane
    cannot be gone round."""
    limit_yielding: Yielding | Any | None = ...
    """Weight of the orientation attractor near a joint's limit: a hand that can turn no
    further still moves on. The lesser of the two weights counts."""
    stirring: Stirring | Any | None = ...
    """Motion of the set-point that frees a hand which stands beside such a body."""
    regularizer: Float[Array, ""] | float = 1e-3
    """The root's epsilon: damps accelerations that nothing asks for."""
    action_range: ActionRange = struct.field(default_factory=ActionRange)
    """Physical meaning of a policy action in [-1, 1]^12."""
    jacobian: str = struct.field(pytree_node=False, default="closed_form")
    """`closed_form` (fast) or `autodiff` (the generic tree, its definition)."""

    def __post_init__(self):
        """Fill the defaults in and check the one static choice."""
        if self.jacobian not in ("closed_form", "autodiff"):
            raise ValueError(
                f"jacobian must be 'closed_form' or 'autodiff', not {self.jacobian!r}"
            )
        robot = self.robot
        defaults = {
            "collision": collision_near,
            "self_collision": collision_near,
            "joint_limit": lambda: JointLimitBarrier(robot.q_lower, robot.q_upper),
            "posture": lambda: Posture(q_0=robot.q_home, kq=2.5, kd=10.0),
            "yielding": Yielding,
            "limit_yielding": limit_yielding,
            "stirring": Stirring,
        }
        for name, make in defaults.items():
            if getattr(self, name) is ...:
                object.__setattr__(self, name, make())
        if isinstance(self.collision, Mapping):
            kinds = tuple(KINDS.values())
            for kind in self.collision:
                if kind not in kinds:
                    raise ValueError(unknown("kind of obstacle", kind, kinds))
            leaves = dict.fromkeys(kinds, collision_near()) | dict(self.collision)
            object.__setattr__(self, "collision", leaves)

    def decode(self, action: Float[Array, " 12"]) -> Action:
        """Physical units of a policy action in [-1, 1]^12."""
        return self.action_range.decode(action)

    def setpoint(self, q: Float[Array, " n"], action: Action) -> Setpoint:
        """Impedance target: the current site pose displaced by the action."""
        return compose_setpoint(*site_pose(self.robot, q), action)

    def __call__(
        self,
        q: Float[Array, " n"],
        qd: Float[Array, " n"],
        setpoint: Setpoint,
        obstacles: Obstacles,
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
            `orientation_weight` in [0, 1], what yielding leaves of the orientation.
        """
        arm = arm_state(self.robot, q, qd)
        Mq, bias = dynamics(self.robot, arm)
        branches, clearance, beside = self._avoidance(arm, obstacles)
        yielded = self._yield(q, beside)
        site = site_state(self.robot, arm)
        if self.stirring is not None:
            stirred = self.stirring(setpoint.time, beside, site.v)
            setpoint = setpoint.replace(p_des=setpoint.p_des + stirred)
        if self.jacobian == "autodiff":
            tree = rmp_vices_tree(self, setpoint, obstacles, Mq, yielded)
            root = evaluate(tree, jnp.asarray(q), jnp.asarray(qd))
        else:
            branches += self._impedance(site, setpoint, yielded)
            if self.joint_limit is not None:
                branches.append(self.joint_limit(q, qd))
            if self.posture is not None:
                branches.append(self.posture(q, qd, Mq))
            root = jax.tree.map(materialize, functools.reduce(operator.add, branches))
        qdd = resolve(root, self.regularizer * Mq)
        dynamic = jnp.matmul(Mq, qdd, precision="highest")
        tau, scale = scale_torque(dynamic, bias, self.robot.tau_max)
        return ControlOutput(
            tau=tau,
            qdd=qdd,
            f=root.f,
            M=root.M,
            diagnostics={
                "torque_scale": scale,
                "clearance": clearance,
                "orientation_weight": yielded,
            },
        )

    def _impedance(
        self, site: SiteState, setpoint: Setpoint, yielded: Float[Array, ""]
    ) -> list[RMP]:
        """The two attractors of the end effector, pulled back to the joints."""
        weight = self.attractor_weight
        position = PositionAttractor(setpoint.p_des, setpoint.kp_pos, weight=weight)
        orientation = orientation_attractor(
            site.R, site.w, setpoint.R_des, setpoint.kp_ori, weight=weight * yielded
        )
        return [
            pullback(position(site.p, site.v), site.J_pos, site.Jdot_qd_pos),
            pullback(orientation, site.J_ori, site.Jdot_qd_ori),
        ]

    def _avoidance(
        self, arm: ArmState, obstacles: Obstacles
    ) -> tuple[list[RMP], Float[Array, ""], Float[Array, ""]]:
        """The collision branches on the joints, the clearance, that to bodies."""
        branches, nearest = [], {}
        if self.collision is not None:
            rmp, nearest = obstacle_branch(self.robot, arm, obstacles, self.collision)
            branches.append(rmp)
        if self.self_collision is not None:
            branches.append(self_branch(self.robot, arm, self.self_collision))
        infinite = jnp.array(jnp.inf, arm.p.dtype)
        bodies = [d for kind, d in nearest.items() if kind != "planes"]
        clearance, beside = (
            functools.reduce(jnp.minimum, distances, infinite)
            for distances in (nearest.values(), bodies)
        )
        return branches, clearance, beside

    def _yield(
        self, q: Float[Array, " n"], beside: Float[Array, ""]
    ) -> Float[Array, ""]:
        """Weight of the orientation, from the joints and the clearance to bodies."""
        weight = jnp.ones_like(beside)
        if self.yielding is not None:
            weight = jnp.minimum(weight, self.yielding(beside))
        if self.limit_yielding is not None:
            room = jnp.minimum(q - self.robot.q_lower, self.robot.q_upper - q)
            weight = jnp.minimum(weight, self.limit_yielding(jnp.min(room)))
        return weight
