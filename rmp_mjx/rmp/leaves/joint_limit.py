"""Joint-limit leaves: a barrier, and RMPflow's for comparison."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.math import speed_gate
from rmp_mjx.pytree import Constant
from rmp_mjx.refuse import refuse_crossed
from rmp_mjx.rmp.leaf import Param, ScalarLeaf
from rmp_mjx.rmp.leaves.barrier import Barrier


def joint_limit_barrier() -> Barrier:
    """The default barrier for joint limits; distances in rad (or m)."""
    return Barrier(mu=2.5e-3, eps=0.2, eta=40.0, r=0.2, margin=0.14, cap=1e3, k_out=2e3)


class JointLimitBarrier(ScalarLeaf):
    """The one-dimensional `Barrier` on both distances, ``q - lower``, ``upper - q``.

    A side at infinity contributes exactly nothing.
    """

    lower: Float[Constant, "*s"]
    """Lower limits, (n,), [rad] or [m]; -inf for none."""
    upper: Float[Constant, "*s"]
    """Upper limits, (n,), [rad] or [m]; +inf for none."""
    barrier: Barrier = flax.struct.field(default_factory=joint_limit_barrier)
    """The barrier applied to each side; its fields may be scalars or (n,)."""

    def __post_init__(self):
        """Check the limits.

        Raises:
            ValueError: A lower limit is above the upper one.
        """
        refuse_crossed(self.lower, self.upper, ("lower", "upper"))

    def braking(self, stop_time: Float[Array, ""] | float) -> JointLimitBarrier:
        """The barriers for an arm that needs this time to stop [s]."""
        return self.replace(barrier=self.barrier.braking(stop_time))

    def scalar(
        self, x: Float[Array, "*s"], xd: Float[Array, "*s"]
    ) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
        """Force (n,) and metric (n,) at joint positions and velocities."""
        f_lower, m_lower = self.barrier.scalar(x - self.lower, xd)
        f_upper, m_upper = self.barrier.scalar(self.upper - x, -xd)
        return f_lower - f_upper, m_lower + m_upper

    def scalar_against(
        self, x: Float[Array, "*s"], xd: Float[Array, "*s"], push: Float[Array, "*s"]
    ) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
        """As `scalar`, where contacts accelerate the joints by ``push``."""
        barrier = self.barrier
        f_lower, m_lower = barrier.scalar_against(x - self.lower, xd, push)
        f_upper, m_upper = barrier.scalar_against(self.upper - x, -xd, -push)
        return f_lower - f_upper, m_lower + m_upper


def _span(
    lower: Float[Constant, "*s"], upper: Float[Constant, "*s"]
) -> tuple[Array, Array, Array]:
    """Finite lower end and width, and the mask of joints limited on both sides."""
    limited = jnp.isfinite(lower) & jnp.isfinite(upper)
    low = jnp.where(limited, lower, 0.0)
    return low, jnp.where(limited, upper, 1.0) - low, limited


class RMPflowJointLimit(ScalarLeaf):
    r"""The velocity-gated joint-limit metric of RMPflow, as its authors code it.

    With $s = (q - l)/(u - l)$, $d = 4 s (1 - s)$ and gates
    $\alpha_u = 1 - \exp(-\max(\dot q, 0)^2 / 2\sigma^2)$ ($\alpha_l$ with
    min):

    $$
    \begin{split}
    b &= s (\alpha_u d + 1 - \alpha_u) + (1 - s)(\alpha_l d + 1 - \alpha_l) \\
    m &= \lambda b^{-2}, \quad f = m (\gamma_p (q_0 - q) - \gamma_d \dot q) - \xi,
    \quad \xi = \tfrac12 \lambda \, \partial_q b^{-2} \, \dot q^2
    \end{split}
    $$

    It is a brake that acts on fast joints, not a wall: at rest the metric is
    ``lambda`` everywhere. Joints without two finite limits contribute nothing.

    Source: Cheng et al., "RMPflow" (2018), appendix on joint limits.
    """

    lower: Float[Constant, "*s"]
    """Lower limits, (n,), [rad]."""
    upper: Float[Constant, "*s"]
    """Upper limits, (n,), [rad]."""
    q_0: Float[Constant, "*s"] | None = None
    """Rest position, (n,), [rad]; the middle of the range if None."""
    lam: Param = 0.01
    """Metric scale."""
    sigma: Param = 0.1
    """Width of the velocity gate, [rad/s]."""
    gamma_p: Param = 0.05
    """Stiffness, [1/s^2]."""
    gamma_d: Param = 0.1
    """Damping, [1/s]."""
    b_min: Param = 1e-2
    """Clamp of b from below: the metric is at most ``lam / b_min^2``."""

    def scalar(
        self, x: Float[Array, "*s"], xd: Float[Array, "*s"]
    ) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
        """Force (n,) and metric (n,) at joint positions and velocities."""
        low, width, limited = _span(self.lower, self.upper)
        alpha_u = speed_gate(jnp.maximum(xd, 0.0), self.sigma)
        alpha_l = speed_gate(jnp.minimum(xd, 0.0), self.sigma)

        def inverse_b2(q):
            s = jnp.clip((q - low) / width, 0.0, 1.0)
            d = 4.0 * s * (1.0 - s)
            b = s * (alpha_u * d + 1.0 - alpha_u)
            b = b + (1.0 - s) * (alpha_l * d + 1.0 - alpha_l)
            return jnp.maximum(b, self.b_min) ** -2

        q = jnp.where(limited, x, low + 0.5 * width)
        weight, slope = jax.jvp(inverse_b2, (q,), (jnp.ones_like(q),))
        q_0 = low + 0.5 * width if self.q_0 is None else self.q_0
        m = self.lam * weight
        f = m * (self.gamma_p * (q_0 - q) - self.gamma_d * xd)
        f = f - 0.5 * self.lam * slope * xd * xd
        return jnp.where(limited, f, 0.0), jnp.where(limited, m, 0.0)

    def scalar_against(
        self, x: Float[Array, "*s"], xd: Float[Array, "*s"], push: Float[Array, "*s"]
    ) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
        """As `scalar`: RMPflow's leaf takes no notice of contacts."""
        del push
        return self.scalar(x, xd)
