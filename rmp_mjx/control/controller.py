"""What a controller is, and what the impedance controllers share."""

from __future__ import annotations

import abc
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, ArrayLike, Float, Real

from rmp_mjx.control.action import ActionRange, compose_setpoint
from rmp_mjx.control.arguments import (
    check,
    check_action,
    check_number,
    check_obstacles,
    check_setpoint,
    check_state,
)
from rmp_mjx.control.fail_safe import Inputs, answered, judged
from rmp_mjx.control.guard import StopGuard
from rmp_mjx.math import psd_solve
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.pytree import Constant, Pytree
from rmp_mjx.robot.kinematics import ArmState, arm_state, site_pose
from rmp_mjx.robot.model import Robot
from rmp_mjx.types import Action, ControlOutput, Setpoint


@runtime_checkable
class Controller(Protocol):
    """From a policy's action to joint torques, for one state; callers vmap it.

    At every policy step ``setpoint(q, decode(action), time)`` gives the target. The
    call gives the torque at every control step until the next one. All three are pure
    functions. What `decode` returns is what `setpoint` takes, and what that returns is
    what the call takes: they are `Action` and `Setpoint` for the controllers here.
    """

    def decode(self, action: Float[Array, " m"]) -> Any:
        """Physical units of a policy's action in [-1, 1]^m, m = 12 if not else said.

        A controller that takes another number has the property `action_size`.
        """
        ...

    def setpoint(self, q: Float[Array, " n"], action: Any, time: Any) -> Any:
        """The target from joint positions [rad], action and time of the step [s]."""
        ...

    def __call__(
        self,
        q: Float[Array, " n"],
        qd: Float[Array, " n"],
        setpoint: Any,
        obstacles: Obstacles,
        tau_ext: Float[Array, " n"] | None = None,
        tau_last: Float[Array, " n"] | None = None,
    ) -> ControlOutput:
        """Torque for joint positions [rad] and velocities [rad/s].

        `tau_ext` is the joint torque of the contacts [N m] as far as it is known, and
        `tau_last` the torque of the last control step [N m], which matters where the
        robot has a limit of its rate.
        """
        ...


class ImpedanceController(Pytree, abc.ABC):
    """A controller whose target is a pose and a stiffness of the end effector."""

    robot: Robot
    """The arm."""
    action_range: ActionRange = struct.field(default_factory=ActionRange, kw_only=True)
    """Physical meaning of a policy action in [-1, 1]^m."""
    period: Float[Constant, ""] | float = struct.field(default=0.005, kw_only=True)
    """Time between two calls [s], for the limits of speed and torque rate."""
    guard: StopGuard | None = struct.field(default=None, kw_only=True)
    """Sends a torque only if the arm can stop after it, see `StopGuard`; None: off. Its
    diagnostics join the controller's."""

    @property
    def action_size(self) -> int:
        """Entries m of a policy's action."""
        return self.action_range.size

    def decode(self, action: Float[ArrayLike, " m"]) -> Action:
        """Physical units of a policy's action in [-1, 1]^m, (m,).

        Raises:
            ValueError: The action has another shape or no floats.
        """
        return self.action_range.decode(action)

    def setpoint(
        self,
        q: Float[ArrayLike, " n"],
        action: Action,
        time: Real[ArrayLike, ""],
    ) -> Setpoint:
        """Impedance target: the current site pose displaced by the action.

        Args:
            q: Joint positions, (n,) [rad].
            action: Displacement and stiffness, from `decode`.
            time: Time of the policy step since the start of the episode [s].

        Raises:
            ValueError: An argument has another shape or no floats.
        """
        check("q", q, (self.robot.n,))
        check_action(action)
        check_number("time", time)
        p, R = site_pose(self.robot, jnp.asarray(q))
        return compose_setpoint(p, R, action, time)

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
            tau_ext: Joint torque of the contacts, (n,) [N m], measured or from a
                `ContactObserver`; None: not known.
            tau_last: Torque of the last control step, (n,) [N m]; None: not known. It
                matters where the robot has a limit of the torques' rate.

        Returns:
            What `unguarded` gives, behind the guard if there is one, and whether the
            inputs are `usable`. If not, the torque is a fall-back: docs/fail_safe.md.

        Raises:
            ValueError: An argument has a wrong shape or dtype.
        """
        check_state(self.robot.n, q, qd, tau_ext, tau_last)
        check_setpoint(setpoint)
        check_obstacles(obstacles)
        ext, last = (
            None if tau is None else jnp.asarray(tau) for tau in (tau_ext, tau_last)
        )
        state = jnp.asarray(q), jnp.asarray(qd)
        safe, verdict = judged(Inputs(*state, setpoint, obstacles, ext, last))
        arm = arm_state(self.robot, safe.q, safe.qd)
        out = self.unguarded(arm, *safe[2:])
        out = self._guarded(out, arm, safe.obstacles, safe.tau_ext)
        return answered(self.robot, arm, out, verdict)

    @abc.abstractmethod
    def unguarded(
        self,
        arm: ArmState,
        setpoint: Setpoint,
        obstacles: Obstacles,
        tau_ext: Float[Array, " n"] | None,
        tau_last: Float[Array, " n"] | None,
    ) -> ControlOutput:
        """The controller's own output for one state; arguments as of the call."""

    def _guarded(
        self,
        out: ControlOutput,
        arm: ArmState,
        obstacles: Obstacles,
        tau_ext: Float[Array, " n"] | None,
    ) -> ControlOutput:
        """What is sent of an output: itself without a guard.

        The guard would replace a torque that is not finite, and the fail-safe has to
        see it.
        """
        if self.guard is None:
            return out
        tau, found = self.guard(
            self.robot, arm, out.tau, out.Mq, out.bias, obstacles, tau_ext
        )
        changed = psd_solve(out.Mq, tau - out.bias)
        return out.replace(
            tau=jnp.where(jnp.isfinite(out.tau), tau, out.tau),
            qdd=jnp.where(found["guard_used"] > 0.0, changed, out.qdd),
            diagnostics=out.diagnostics | found,
        )
