"""RMP-VICES: the impedance target fused with avoidance over the whole arm."""

from __future__ import annotations

import functools
import operator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, ArrayLike, Float

from rmp_mjx.control.avoidance import Surroundings, obstacle_branch, self_branch
from rmp_mjx.control.contact import ContactResponse, turning_by_contact
from rmp_mjx.control.controller import ImpedanceController
from rmp_mjx.control.dither import SetpointDither
from rmp_mjx.control.leaves import CollisionLeaf, Leaves
from rmp_mjx.control.relaxation import OrientationRelaxation, joint_limit_relaxation
from rmp_mjx.control.root import Rows, solve_root
from rmp_mjx.control.torque import clip_torque, speed_range, stop_time, torque_range
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.pytree import Constant
from rmp_mjx.refuse import not_negative, refuse_unless
from rmp_mjx.rmp import RMP, Leaf, Node, Siblings, evaluate, pullback
from rmp_mjx.rmp.leaves.attractor import PositionAttractor, orientation_attractor
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import ArmState, SiteState, site_state
from rmp_mjx.types import ControlOutput, Setpoint
from rmp_mjx.xla import materialize

_DEFAULT: Any = None  # stands for leaves that depend on the robot


class RMPVICES(ImpedanceController):
    r"""Variable-impedance control as the attractor of an RMP-tree (paper, section III).

    One call evaluates the tree at (q, qd), resolves its root in the inertia metric
    under the limits of the motors, and turns the acceleration into torque:

    $$
    \min_{\ddot q} \tfrac12 \ddot q^T (M + \epsilon M_q)\, \ddot q - f^T \ddot q
    \quad \text{s.t.} \quad |\tau| \le \tau_{max}, \quad
    \tau = M_q \ddot q + b .
    $$

    While no joint is at its limit this is $(M + \epsilon M_q)\, \ddot q = f$. The
    inertia-weighted regulariser makes the tree without its safety leaves converge
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
    contact: ContactResponse | None = struct.field(default_factory=ContactResponse)
    """What is done with the contacts' torque, where it is given; None: nothing."""
    dither: SetpointDither | None = struct.field(default_factory=SetpointDither)
    """Motion of the set-point that frees a hand at rest beside such an obstacle."""
    regularizer: Float[Constant, ""] | float = 1e-3
    """The root's epsilon: damps accelerations that no leaf determines."""
    braking_share: Float[Constant, ""] | float | None = 0.7
    """Share of the motors' torque that the safety leaves count on for braking. The
    less, the earlier they brake. None: they do not look at the motors."""
    extra: tuple[Node | Siblings | Leaf, ...] = ()
    """Branches of your own on the joints, beside those of the library."""

    def __post_init__(self):
        """Fill in the default leaves, which depend on the robot.

        Raises:
            ValueError: The regulariser is negative or not finite.
        """
        wanted = "finite and not negative"
        refuse_unless(not_negative, "regularizer", self.regularizer, wanted)
        if self.leaves is None:
            object.__setattr__(self, "leaves", Leaves.default(self.robot))

    def with_collision(self, collision: CollisionLeaf | None) -> RMPVICES:
        """The same controller with another collision leaf; see `Leaves`."""
        return self.replace(leaves=self.leaves.with_collision(collision))

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
            Torque, acceleration, root RMP and diagnostics. These are `torque_limit`,
            and `velocity_limit` if the robot has one (n,), -1 or 1 for a joint at its
            limit; `clearance` [m], the least distance of a control point to an
            obstacle; `stop_time` [s], see `torque.stop_time`; and the weights of this
            state, `attractor_weight` and `orientation_weight`, in [0, 1].
        """
        Mq, bias = dynamics(self.robot, arm)
        w = self._by_contact(Mq, tau_ext)
        asked, found = self._asked(arm, setpoint, obstacles, (Mq, bias, tau_ext, w))
        total = functools.reduce(operator.add, asked.values())
        root = jax.tree.map(materialize, total)
        solution = self.resolve(root, Mq, bias, arm.qd, w, tau_last)
        return ControlOutput(
            tau=solution.tau,
            qdd=solution.qdd,
            f=root.f,
            M=root.M,
            Mq=Mq,
            bias=bias,
            diagnostics=solution.limits | found,
        )

    def asked(
        self,
        arm: ArmState,
        setpoint: Setpoint,
        obstacles: Obstacles,
        tau_ext: Float[Array, " n"] | None = None,
    ) -> dict[str, RMP]:
        """What each branch of the tree asks of the joints; their sum is the root.

        Args:
            arm: State of the arm.
            setpoint: Impedance target.
            obstacles: Padded obstacle slots.
            tau_ext: Joint torque of the contacts, (n,) [N m]; None: not known.

        Returns:
            RMPs on the joints, f (n,) and M (n, n), by name: `collision`,
            `self_collision`, `position`, `orientation`, `joint_limit` and `posture` if
            there is such a leaf, and `extra_0`, ... for branches of your own.
        """
        Mq, bias = dynamics(self.robot, arm)
        w = self._by_contact(Mq, tau_ext)
        return self._asked(arm, setpoint, obstacles, (Mq, bias, tau_ext, w))[0]

    def _asked(
        self,
        arm: ArmState,
        setpoint: Setpoint,
        obstacles: Obstacles,
        loads: tuple[Array, Array, Array | None, Array | None],
    ) -> tuple[dict[str, RMP], dict[str, Array]]:
        """What the branches ask, and the diagnostics of this state."""
        q, qd = arm.q, arm.qd
        Mq, bias, tau_ext, w = loads
        load = bias if w is None or tau_ext is None else bias - tau_ext
        leaves, stop = self._braking(Mq, load, qd)
        leaves = leaves.weighted(setpoint.weights)
        asked, around = self._avoidance(leaves, arm, obstacles, w)
        clearance, body_clearance = _nearest(around, arm.p.dtype)
        site = site_state(self.robot, arm)
        if self.dither is not None:
            moved = self.dither(setpoint.time, body_clearance, site.v)
            setpoint = setpoint.replace(p_des=setpoint.p_des + moved)
        orientation_weight = self._orientation_weight(q, body_clearance)
        attractor_weight = jnp.ones_like(clearance)
        if setpoint.weights is not None:
            attractor_weight = attractor_weight * setpoint.weights.attractor
        turning = jnp.zeros(3, arm.p.dtype)
        if self.contact is not None and w is not None:
            attractor_weight *= self.contact.attractor_weight(around.pressed)
            turning = turning_by_contact(site, Mq, w)
        asked["position"], asked["orientation"] = self._impedance(
            site, setpoint, attractor_weight, orientation_weight, turning
        )
        if leaves.joint_limit is not None:
            leaf = leaves.joint_limit
            limit = leaf(q, qd) if w is None else leaf.against(q, qd, w)
            asked["joint_limit"] = limit
        if leaves.posture is not None:
            asked["posture"] = leaves.posture(q, qd, Mq)
        for k, branch in enumerate(self.extra):
            asked[f"extra_{k}"] = evaluate(branch, q, qd, w)
        return asked, {
            "clearance": clearance,
            "stop_time": stop,
            "attractor_weight": attractor_weight,
            "orientation_weight": orientation_weight,
        }

    def resolve(
        self,
        root: RMP,
        Mq: Float[Array, "n n"],
        bias: Float[Array, " n"],
        qd: Float[Array, " n"],
        w: Float[Array, " n"] | None = None,
        tau_last: Float[ArrayLike, " n"] | None = None,
    ) -> RootSolution:
        """Torque from the root RMP, under the limits of the motors.

        Args:
            root: The root.
            Mq: Inertia, (n, n) [kg m^2].
            bias: Coriolis and gravity torques, (n,) [N m].
            qd: Joint velocities, (n,) [rad/s].
            w: Joint acceleration by contacts, (n,) [rad/s^2].
            tau_last: Torque of the last control step, (n,) [N m].
        """
        H = root.M + self.regularizer * Mq
        low, high = torque_range(self.robot, tau_last, self.period)
        limits = {"torque_limit": Rows.hard(Mq, low - bias, high - bias)}
        if self.robot.qd_max is not None:
            qdd_range = speed_range(self.robot.qd_max, qd, w, self.period)
            limits["velocity_limit"] = Rows.soft(jnp.eye(self.robot.n), *qdd_range)
        qdd, at_end = solve_root(H, root.f, Rows.join(limits.values()))
        found = dict(zip(limits, jnp.split(at_end, len(limits)), strict=True))
        tau = jnp.matmul(Mq, qdd, precision="highest") + bias
        held = found["torque_limit"]
        tau = jnp.where(held > 0.0, high, jnp.where(held < 0.0, low, tau))
        tau = jnp.where(jnp.isfinite(qdd), tau, jnp.nan)  # for the fail-safe to see
        tau, found["torque_limit"] = clip_torque(tau, low, high)
        return RootSolution(qdd, tau, found)

    def _by_contact(
        self, Mq: Float[Array, "n n"], tau_ext: Float[Array, " n"] | None
    ) -> Float[Array, " n"] | None:
        """Joint acceleration by the contacts, if it is known and counts."""
        if self.contact is None or tau_ext is None:
            return None
        return self.contact.acceleration(Mq, tau_ext)

    def _braking(
        self, Mq: Float[Array, "n n"], load: Float[Array, " n"], qd: Float[Array, " n"]
    ) -> tuple[Leaves, Float[Array, ""]]:
        """The leaves for an arm that needs some time to stop, and that time [s]."""
        if self.braking_share is None:
            return self.leaves, jnp.zeros((), Mq.dtype)
        tau_max = jnp.asarray(self.robot.tau_max)
        time = stop_time(Mq, load, qd, tau_max, self.braking_share)
        return self.leaves.braking(time), time

    def _impedance(
        self,
        site: SiteState,
        setpoint: Setpoint,
        attractor_weight: Float[Array, ""],
        orientation_weight: Float[Array, ""],
        turning: Float[Array, " 3"],
    ) -> tuple[RMP, RMP]:
        """The two attractors of the end effector, pulled back to the joints."""
        weight = self.attractor_weight * attractor_weight
        position = PositionAttractor(setpoint.p_des, setpoint.kp_pos, weight=weight)
        orientation = orientation_attractor(
            site.R,
            site.w,
            setpoint.R_des,
            setpoint.kp_ori,
            weight=weight * orientation_weight,
            feedforward=-turning,
        )
        return (
            pullback(position(site.p, site.v), site.J_pos, site.Jdot_qd_pos),
            pullback(orientation, site.J_ori, site.Jdot_qd_ori),
        )

    def _avoidance(
        self,
        leaves: Leaves,
        arm: ArmState,
        obstacles: Obstacles,
        w: Float[Array, " n"] | None,
    ) -> tuple[dict[str, RMP], Surroundings]:
        """Collision RMPs on the joints, and what is about."""
        asked, around = {}, Surroundings({}, jnp.zeros((), arm.p.dtype))
        if leaves.collision is not None:
            near = 0.0 if self.contact is None else self.contact.near
            asked["collision"], around = obstacle_branch(
                self.robot, arm, obstacles, leaves.collision, w, near
            )
        if leaves.self_collision is not None:
            rmp = self_branch(self.robot, arm, leaves.self_collision, w)
            asked["self_collision"] = rmp
        return asked, around

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


class RootSolution(NamedTuple):
    """What the root asks of the motors."""

    qdd: Float[Array, " n"]
    """Joint acceleration while nothing touches [rad/s^2]."""
    tau: Float[Array, " n"]
    """Torque within the limits [N m]."""
    limits: dict[str, Float[Array, " n"]]
    """By name of a limit: -1 or 1 for a joint at its lower or upper end, else 0."""


def _nearest(
    around: Surroundings, dtype: Any
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Least clearance, and that without planes [m]; infinite without obstacles."""
    infinite = jnp.array(jnp.inf, dtype)
    bodies = [d for kind, d in around.clearance.items() if kind != "planes"]
    clearance, body_clearance = (
        functools.reduce(jnp.minimum, distances, infinite)
        for distances in (around.clearance.values(), bodies)
    )
    return clearance, body_clearance
