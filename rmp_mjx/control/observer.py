"""The contacts' joint torque, from what an arm measures: q, qd and its own torque."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Real

from rmp_mjx.control.arguments import check
from rmp_mjx.pytree import Constant, Pytree
from rmp_mjx.robot.model import Robot

DRY_SPEED = 0.01
"""Speed over which dry friction turns its sign [rad/s or m/s]."""


class ContactMemory(Pytree):
    """What an observer carries from one control step to the next."""

    qd: Float[Array, " n"]
    """Joint velocities measured at the last step [rad/s]."""
    Mq: Float[Array, "n n"]
    """Inertia then [kg m^2]."""
    bias: Float[Array, " n"]
    """Bias then, as `rmp_mjx.robot.dynamics` gives it [N m]."""
    tau: Float[Array, " n"]
    """Torque that the motors have given since [N m]."""
    tau_ext: Float[Array, " n"]
    """Estimate at the last step, before delay and dead band [N m]."""
    late: Float[Array, "delay n"]
    """Estimates that are still under way, oldest first [N m]."""
    started: Bool[Array, ""]
    """Whether there was a last step."""

    def then(
        self,
        Mq: Float[ArrayLike, "n n"],
        bias: Float[ArrayLike, " n"],
        tau: Float[ArrayLike, " n"],
    ) -> ContactMemory:
        """With the model and the torque of the step whose velocity was just taken in.

        Args:
            Mq: Inertia, (n, n) [kg m^2]; `ControlOutput.Mq`.
            bias: Bias, (n,) [N m]; `ControlOutput.bias`.
            tau: Torque that the motors give until the next step, after any clipping,
                (n,) [N m].

        Raises:
            ValueError: An argument has another shape or no floats.
        """
        known = {"Mq": Mq, "bias": bias, "tau": tau}
        for name, value in known.items():
            check(name, value, getattr(self, name).shape)
        dtype = self.qd.dtype
        known = {name: jnp.asarray(value, dtype) for name, value in known.items()}
        return self.replace(**known, started=jnp.ones_like(self.started))


class ContactObserver(Pytree):
    r"""External joint torque from joint velocities, a model, and the motors' torques.

    With $M_q \ddot q + b + d(\dot q) = \tau + \tau_{ext}$, d the joints' friction, the
    torque that has acted since the last control step, h ago, is

    $$
    x_k = M_{k-1} \frac{\dot q_k - \dot q_{k-1}}{h} + b_{k-1} + d(\dot q_k) -
    \tau_{k-1}, \quad
    d_i(\dot q) = D_i \dot q_i + F_i \tanh(\dot q_i / v_0) .
    $$

    MuJoCo's integrator takes damping at the new velocity, so with D known this
    *one-step form* is the engine's constraint torque up to rounding, one step late.
    With a `gain` K the estimate is its low-pass

    $$
    r_k = r_{k-1} + (1 - e^{-K h}) (x_k - r_{k-1}) .
    $$

    That is the *momentum observer* (De Luca and Mattone, 2005; Haddadin, De Luca and
    Albu-Schaeffer, "Robot collisions: a survey", 2017, section IV.E) for a torque that
    is constant within a step: with $p = M_q \dot q$ and $\dot M_q = C + C^T$,

    $$
    r = K \Bigl( p - \int (\tau + C^T \dot q - g - d + r)\, dt - p_0 \Bigr)
    \;\Rightarrow\;
    \dot r = K (M_q \ddot q + C \dot q + g + d - \tau - r) = K (\tau_{ext} - r) .
    $$

    Its delay is 1/K. Noise of standard deviation s in the velocities becomes
    $M_q s \sqrt{2 a^2 / (2 - a)} / h$ in the estimate, $a = 1 - e^{-K h}$, and
    $\sqrt 2 M_q s / h$ without a gain.

    A step of the loop:

        tau_ext, memory = observer.estimate(memory, qd, dt)
        out = ctrl(q, qd, setpoint, obstacles, tau_ext=tau_ext)
        memory = memory.then(out.Mq, out.bias, out.tau)

    What the model lacks (a payload, springs that the robot does not declare) is in the
    estimate, too.
    """

    damping: Float[Constant, " n"] | None = None
    """Viscous friction of the joints, D; None for none [N m s/rad or N s/m]."""
    held: Float[Constant, " n"] | None = None
    """What of it is in `bias` already, `Robot.damping`; None for none."""
    dry: Float[Constant, " n"] | None = None
    """Dry friction of the joints in motion, F; None for none [N m or N]."""
    gain: Float[Constant, ""] | float | None = None
    """Bandwidth of the momentum observer, K [1/s]; None for the one-step form."""
    dead_band: Float[Constant, ""] | float = 0.0
    """Torque that counts as none; the rest is lessened by as much [N m or N]."""
    delay: int = struct.field(pytree_node=False, default=0)
    """Control steps that an estimate is under way."""

    @staticmethod
    def of(
        robot: Robot,
        gain: Float[Constant, ""] | float | None = None,
        dead_band: Float[Constant, ""] | float = 0.0,
        delay: int = 0,
    ) -> ContactObserver:
        """With the friction of the robot's own MJCF, compensated or not.

        Args:
            robot: The arm. Its rotor inertias are in the inertia that it gives.
            gain: See `gain`.
            dead_band: See `dead_band`.
            delay: See `delay`.
        """
        damping, dry = robot.friction
        return ContactObserver(
            damping=damping if np.any(damping) else None,
            held=robot.damping,
            dry=dry if np.any(dry) else None,
            gain=gain,
            dead_band=dead_band,
            delay=delay,
        )

    def start(self, n: int) -> ContactMemory:
        """Memory before the first step: nothing measured, no torque.

        Args:
            n: Number of joints.
        """
        zero = jnp.zeros(n)
        return ContactMemory(
            qd=zero,
            Mq=jnp.zeros((n, n)),
            bias=zero,
            tau=zero,
            tau_ext=zero,
            late=jnp.zeros((self.delay, n)),
            started=jnp.zeros((), bool),
        )

    def estimate(
        self,
        memory: ContactMemory,
        qd: Float[ArrayLike, " n"],
        dt: Real[ArrayLike, ""],
    ) -> tuple[Float[Array, " n"], ContactMemory]:
        """External torque, from the velocity at this step and what was remembered.

        Args:
            memory: From `start`, or from `ContactMemory.then` at the last step.
            qd: Joint velocities measured now, (n,) [rad/s].
            dt: Time since the last step, h [s].

        Returns:
            The estimate (n,) [N m], zero at the first step, and the memory with `qd` in
            it; `ContactMemory.then` completes it.

        Raises:
            ValueError: The velocities have another shape or are no floats.
        """
        check("qd", qd, memory.qd.shape)
        qd = jnp.asarray(qd, memory.qd.dtype)
        r = memory.tau_ext
        change = self._residual(memory, qd, dt) - r
        if self.gain is not None:
            change = -jnp.expm1(-self.gain * dt) * change
        r = jnp.where(memory.started, r + change, r)
        under_way = jnp.concatenate([memory.late, r[None]])
        late, out = under_way[1:], under_way[0]
        out = out - jnp.clip(out, -self.dead_band, self.dead_band)
        return out, memory.replace(qd=qd, tau_ext=r, late=late)

    def _residual(
        self, memory: ContactMemory, qd: Float[Array, " n"], dt: Real[ArrayLike, ""]
    ) -> Float[Array, " n"]:
        """The one-step form, x_k [N m]."""
        change = (qd - memory.qd) / dt
        x = jnp.matmul(memory.Mq, change, precision="highest")
        x = x + memory.bias - memory.tau
        if self.damping is not None:
            x = x + jnp.asarray(self.damping, qd.dtype) * qd
        if self.held is not None:
            x = x - jnp.asarray(self.held, qd.dtype) * memory.qd
        if self.dry is not None:
            x = x + jnp.asarray(self.dry, qd.dtype) * jnp.tanh(qd / DRY_SPEED)
        return x
