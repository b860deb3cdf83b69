r"""What a controller does with inputs that it cannot use.

Each input is judged by itself and, where it cannot be used, replaced by a harmless one
before anything is computed. So values and derivatives stay finite, and the other states
of a batch are computed as ever. The torque of such a state is then the `fall_back`.
`docs/fail_safe.md` says what a caller gets for which input.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from rmp_mjx.control.torque import clip_torque, stop_time
from rmp_mjx.math import bounded, is_rotation
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.robot.kinematics import ArmState
from rmp_mjx.robot.model import Robot
from rmp_mjx.types import ControlOutput, Setpoint

BRAKING_TIME = 0.1
"""Time constant of the joints' braking [s], where the motors need no longer."""

LATEST = 1e9
"""Latest time of a set-point [s]: 30 years."""


class Inputs(NamedTuple):
    """The arguments of a controller's call."""

    q: Float[Array, " n"]
    """Joint positions [rad or m]."""
    qd: Float[Array, " n"]
    """Joint velocities [rad/s or m/s]."""
    setpoint: Setpoint
    """Impedance target."""
    obstacles: Obstacles
    """Obstacle slots."""
    tau_ext: Float[Array, " n"] | None
    """Joint torque of the contacts [N m or N]."""
    tau_last: Float[Array, " n"] | None
    """Torque of the last control step [N m or N]."""


class Verdict(NamedTuple):
    """What can be used."""

    position: Bool[Array, ""]
    """The joint positions."""
    all: Bool[Array, ""]
    """Every input."""


def judged(given: Inputs) -> tuple[Inputs, Verdict]:
    """Inputs to compute with, and which of the given ones can be used.

    What cannot be used becomes zero, and an obstacle a slot that is not in use.
    """
    target = _is_target(given.setpoint)
    obstacles, sound = given.obstacles.cleared()
    joints = (given.q, given.qd, given.tau_ext, given.tau_last)
    good = jax.tree.map(bounded, joints)
    every = jnp.stack([target, sound, *jax.tree.leaves(good)])

    def kept(x: ArrayLike, ok: Array) -> Array:
        return jnp.where(ok, x, 0.0)

    q, qd, tau_ext, tau_last = jax.tree.map(kept, joints, good)
    setpoint = jax.tree.map(lambda x: kept(x, target), given.setpoint)
    safe = Inputs(q, qd, setpoint, obstacles, tau_ext, tau_last)
    return safe, Verdict(good[0], jnp.all(every))


def _is_target(setpoint: Setpoint) -> Bool[Array, ""]:
    """Whether a set-point is one: a pose, and stiffnesses and weights of no sign."""
    stiffness = jnp.concatenate([setpoint.kp_pos, setpoint.kp_ori])
    good = bounded(setpoint.p_des) & is_rotation(setpoint.R_des)
    good &= bounded(stiffness, low=0.0) & (jnp.abs(setpoint.time) <= LATEST)
    for weight in jax.tree.leaves(setpoint.weights):
        good &= bounded(weight, low=0.0)
    return good


def answered(
    robot: Robot, arm: ArmState, out: ControlOutput, verdict: Verdict
) -> ControlOutput:
    """The output for inputs of this verdict, with `usable` among the diagnostics.

    An output that is not finite counts as one of unusable inputs. There the torque is
    the fall-back, and the acceleration and all other diagnostics are zero.

    Args:
        robot: The arm.
        arm: The state that was computed with.
        out: What came of it.
        verdict: Of the inputs.
    """
    usable = verdict.all & jnp.all(jnp.isfinite(out.tau))
    tau = fall_back(robot, arm, out.Mq, out.bias)
    tau = jnp.where(verdict.position, tau, 0.0)
    found = {
        name: jnp.where(usable, x, jnp.zeros_like(x))
        for name, x in out.diagnostics.items()
    }
    return out.replace(
        tau=jnp.where(usable, out.tau, tau),
        qdd=jnp.where(usable, out.qdd, 0.0),
        diagnostics=found | {"usable": jnp.asarray(usable, out.tau.dtype)},
    )


def fall_back(
    robot: Robot,
    arm: ArmState,
    Mq: Float[Array, "n n"],
    bias: Float[Array, " n"],
) -> Float[Array, " n"]:
    r"""The torque that brakes an arm which has nothing else to go by, (n,) [N m].

    $$
    \tau = b - M_q \dot q / T, \quad T = \max(T_0, T_{stop})
    $$

    lets all joints slow down together, $\ddot q = -\dot q / T$, and holds an arm at
    rest against gravity. It takes no energy from the motors: $-\dot q^T M_q \dot q / T$
    is negative. The motors can give it by the choice of T (`stop_time`), unless their
    load alone is beyond them; then it is clipped.

    Args:
        robot: The arm.
        arm: Its state.
        Mq: Inertia, (n, n).
        bias: Coriolis and gravity torques, (n,) [N m].
    """
    tau_max = jnp.asarray(robot.tau_max, bias.dtype)
    time = jnp.maximum(stop_time(Mq, bias, arm.qd, tau_max), BRAKING_TIME)
    momentum = jnp.matmul(Mq, arm.qd, precision="highest")
    tau, _ = clip_torque(bias - momentum / time, -tau_max, tau_max)
    return tau
