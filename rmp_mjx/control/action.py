"""From a policy's action in [-1, 1]^m to physical units, and to a set-point."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Real

from rmp_mjx.control.arguments import check
from rmp_mjx.math import exp_so3
from rmp_mjx.pytree import Constant, Pytree
from rmp_mjx.types import Action, LeafWeights, Setpoint

ACTION_SIZE = 12
"""dpos (3), drot (3), kp_pos (3), kp_ori (3), in this order."""


class ActionRange(Pytree):
    """What -1 and 1 mean. Stiffness is spaced logarithmically."""

    dpos: Float[Constant, ""] | float = 0.05
    """Largest displacement per axis [m]."""
    drot: Float[Constant, ""] | float = 0.2
    """Largest rotation per axis [rad]."""
    kp_min: Float[Constant, ""] | float = 10.0
    """Least stiffness [1/s^2]."""
    kp_max: Float[Constant, ""] | float = 300.0
    """Greatest stiffness [1/s^2]."""

    @property
    def size(self) -> int:
        """Entries of an action."""
        return ACTION_SIZE

    def decode(self, action: Float[ArrayLike, " m"]) -> Action:
        """Map [-1, 1]^m to physical units; values outside are clipped.

        A non-finite entry counts as zero: no displacement, middle stiffness.

        Raises:
            ValueError: The action has another shape or no floats.
        """
        u = self._clipped(action)
        ratio = self.kp_max / jnp.asarray(self.kp_min, u.dtype)
        kp = self.kp_min * ratio ** (0.5 * (u[6:ACTION_SIZE] + 1.0))
        return Action(
            dpos=self.dpos * u[:3],
            drot=self.drot * u[3:6],
            kp_pos=kp[:3],
            kp_ori=kp[3:],
        )

    def _clipped(self, action: ArrayLike) -> Float[Array, " m"]:
        check("action", action, (self.size,))
        action = jnp.asarray(action)
        return jnp.clip(jnp.where(jnp.isfinite(action), action, 0.0), -1.0, 1.0)


class WeightedActionRange(ActionRange):
    r"""A range with three more entries, by which a policy weighs the tree's leaves.

    The safety leaves keep what they can promise, whatever the policy does: their
    metrics stay as they are, and the others stay light beside them. A safety leaf that
    asks for the acceleration a along g, with metric m, gets

    $$
    g \cdot \ddot q - a = \frac{g \cdot \ddot q_0 - a}{1 + m\, g \cdot H^{-1} g},
    $$

    where $\ddot q_0$ is what the root gives without it and H the rest of its metric
    (Sherman and Morrison). The heavier H, the more is missing.

    * *Attractor*, $10^{u}$ for u < 0, else 1: never heavier than in the tree that the
      safety leaves were tuned for.
    * *Posture*, $10^u$: at most 0.2 of the inertia, less than half of what an attractor
      weighs.
    * *Standoff*, 3 cm times u for u > 0, else 0: margins only ever get wider. It may
      grow at once: the push out of a margin fades as the body leaves
      (`Barrier.v_out`), so an arm that stands within the new margin is not thrown out.

    With all three entries zero, or not finite, the tree is as without them.
    docs/controller.md has figures.

    Source: Li et al., "RMPfusion" (2019): a policy's weights on the leaves of a tree.
    """

    attractor_least: Float[Constant, ""] | float = 0.1
    """Least factor on the attractors' metric."""
    posture_most: Float[Constant, ""] | float = 10.0
    """Greatest factor on the posture's metric; its inverse is the least."""
    standoff_most: Float[Constant, ""] | float = 0.03
    """Greatest addition to a margin [m]."""

    @property
    def size(self) -> int:
        """Entries of an action: attractor, posture and standoff come last."""
        return ACTION_SIZE + 3

    def decode(self, action: Float[ArrayLike, " m"]) -> Action:
        """Map [-1, 1]^15 to physical units, as `ActionRange.decode`."""
        attractor, posture, standoff = self._clipped(action)[ACTION_SIZE:]
        least, most = (
            jnp.asarray(x, attractor.dtype)
            for x in (self.attractor_least, self.posture_most)
        )
        weights = LeafWeights(
            attractor=least ** jnp.maximum(-attractor, 0.0),
            posture=most**posture,
            standoff=self.standoff_most * jnp.maximum(standoff, 0.0),
        )
        return super().decode(action).replace(weights=weights)


def compose_setpoint(
    p: Float[Array, " 3"],
    R: Float[Array, "3 3"],
    action: Action,
    time: Real[ArrayLike, ""],
) -> Setpoint:
    """Displace the current site pose by the action (paper, section II-B).

    Args:
        p: Current site position, (3,) [m].
        R: Current site orientation, (3, 3).
        action: Displacement and stiffness in physical units.
        time: Time of the policy step [s].
    """
    return Setpoint(
        p_des=p + action.dpos,
        R_des=jnp.matmul(exp_so3(jnp.asarray(action.drot)), R, precision="highest"),
        kp_pos=action.kp_pos,
        kp_ori=action.kp_ori,
        time=jnp.asarray(time, p.dtype),
        weights=action.weights,
    )
