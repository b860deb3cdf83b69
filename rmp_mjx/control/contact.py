"""How the tree answers to the joint torque of contacts."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.math import psd_solve
from rmp_mjx.pytree import Constant, Pytree
from rmp_mjx.robot.kinematics import SiteState


class ContactResponse(Pytree):
    r"""What the controller does with the contacts' joint torque.

    The contacts accelerate the joints by $w = M_q^{-1} \tau_{ext}$, which the root does
    not command. Three things follow:

    * A safety leaf on a distance d asks for its acceleration on top of what contacts
      take from it: $f \leftarrow f + m \max(-\nabla d \cdot w, 0)$.
    * Release: where contacts press a point near an obstacle on, with
      $p = \max(-\nabla d \cdot w)$, the weight of the attractors falls by
      $c^{\mathrm{clip}(p / p_0, 0, 1)}$. The hand stops pulling at what jams the arm.
    * A blocked hand does not turn: see `turning_by_contact`.

    The attractors do not ask back what contacts take. If they did, the force against a
    wall would grow from step to step.
    """

    cap: Float[Constant, ""] | float = 50.0
    """Largest acceleration of a joint that is believed [rad/s^2]."""
    near: Float[Constant, ""] | float = 0.02
    """Distance within which a point counts for the release [m]."""
    release: Float[Constant, ""] | float = 10.0
    """Acceleration p_0 at which the attractors have let go [m/s^2]."""
    min_weight: Float[Constant, ""] | float = 0.01
    """Their weight c then."""

    def acceleration(
        self, Mq: Float[Array, "n n"], tau_ext: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """Joint acceleration by the contacts, (n,) [rad/s^2], shortened to the cap."""
        w = psd_solve(Mq, tau_ext)
        largest = jnp.max(jnp.abs(w), initial=0.0)
        over = largest > self.cap
        return w * jnp.where(over, self.cap / jnp.where(over, largest, 1.0), 1.0)

    def attractor_weight(self, pressed: Float[Array, ""]) -> Float[Array, ""]:
        """Weight of the attractors where contacts press on by `pressed` [m/s^2]."""
        share = jnp.clip(pressed / self.release, 0.0, 1.0)
        return jnp.asarray(self.min_weight, pressed.dtype) ** share


def turning_by_contact(
    site: SiteState, Mq: Float[Array, "n n"], w: Float[Array, " n"]
) -> Float[Array, " 3"]:
    r"""Angular acceleration of the hand by the contact force that blocks it.

    A contact that takes $a = -J_p w$ from the hand's acceleration does so, if it is a
    force at the end effector, with the force $\Lambda_p J_p w$ and turns the hand by

    $$
    \alpha = J_o M_q^{-1} J_p^T \Lambda_p\, J_p w, \quad
    \Lambda_p = (J_p M_q^{-1} J_p^T)^{-1} .
    $$

    The orientation attractor asks for $-\alpha$ on top of its own acceleration. So a
    blocked hand keeps its orientation, as under the decoupled wrenches of VICES. In
    free motion it is zero. It does not wind up: it follows from what is taken from the
    commanded translation, which it does not change.

    Args:
        site: Jacobians of the end effector.
        Mq: Inertia, (n, n).
        w: Joint acceleration by the contacts, (n,) [rad/s^2].

    Returns:
        Angular acceleration, world frame, (3,) [rad/s^2].
    """
    lift = psd_solve(Mq, site.J_pos.T)
    mobility = jnp.matmul(site.J_pos, lift, precision="highest")
    turn = jnp.matmul(site.J_ori, lift, precision="highest")
    force = psd_solve(mobility, jnp.matmul(site.J_pos, w, precision="highest"))
    return jnp.matmul(turn, force, precision="highest")
