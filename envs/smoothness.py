"""How smooth torques and joint motion are, from one physics step to the next."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rmp_mjx.pytree import Pytree

REVERSAL = 1.0
"""A torque reverses if it changes by more than this one way, then the other [N m]."""


class Torques(Pytree):
    """Torques of the last physics steps within a policy step."""

    tau: Float[Array, " n"]
    """Torques [N m]."""
    change: Float[Array, " n"]
    """Their change in the last step [N m]."""
    reversed: Bool[Array, ""]
    """Whether one of them reversed in the last step."""
    first: Bool[Array, ""]
    """Whether there is no step yet."""

    @staticmethod
    def start(n: int) -> Torques:
        """Before the first step. It counts as no change: the new set-point caused it.

        Args:
            n: Number of joints.
        """
        zero = jnp.zeros(n)
        return Torques(zero, zero, jnp.zeros((), bool), jnp.ones((), bool))

    def then(self, tau: Float[Array, " n"]) -> Torques:
        """After one more step with these torques [N m]."""
        change = jnp.where(self.first, 0.0, tau - self.tau)
        turned = change * self.change < 0
        large = jnp.minimum(jnp.abs(change), jnp.abs(self.change)) > REVERSAL
        return Torques(tau, change, jnp.any(turned & large), jnp.zeros((), bool))


class Motion(Pytree):
    """Joint velocities and accelerations of the last physics steps."""

    qd: Float[Array, " n"]
    """Joint velocities [rad/s]."""
    qdd: Float[Array, " n"]
    """Their change in the last step, divided by its time [rad/s^2]."""
    jerk: Float[Array, " n"]
    """Change of `qdd` in the last step, divided by its time [rad/s^3]."""
    first: Bool[Array, ""]
    """Whether there is no step yet."""

    @staticmethod
    def start(qd: Float[Array, " n"]) -> Motion:
        """Before the first step. It has no jerk: the new set-point caused it.

        Args:
            qd: Joint velocities [rad/s].
        """
        zero = jnp.zeros_like(qd)
        return Motion(qd, zero, zero, jnp.ones((), bool))

    def then(self, qd: Float[Array, " n"], dt: float) -> Motion:
        """After one more step of `dt` [s] that led to these velocities [rad/s]."""
        qdd = (qd - self.qd) / dt
        jerk = jnp.where(self.first, 0.0, (qdd - self.qdd) / dt)
        return Motion(qd, qdd, jerk, jnp.zeros((), bool))
