"""VICES, the baseline operational-space controller, and OSC, its fixed impedance."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from rmp_mjx.control.controller import ImpedanceController
from rmp_mjx.control.torque import clip_torque, torque_range
from rmp_mjx.math import critical_damping, orientation_error, psd_solve
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.pytree import Constant
from rmp_mjx.rmp.leaves.posture import Posture
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import ArmState, site_state
from rmp_mjx.types import Action, ControlOutput, Setpoint


class VICES(ImpedanceController):
    r"""Decoupled operational-space impedance control (paper, eq. 2).

    $$
    \tau = J_p^T \Lambda_p (k_p (p_{des} - p) - k_d v) +
    J_o^T \Lambda_o (k_p\, e_r(R, R_{des}) - k_d \omega) +
    N^T M_q \ddot q_0 + b
    $$

    with critical damping, $\Lambda = (J M_q^{-1} J^T)^{-1}$ of each block by
    itself, a posture acceleration $\ddot q_0$ in the dynamically consistent
    null space (gains 10 and 2 sqrt(10), as in VICES' code), and torques clipped joint
    by joint. It takes obstacles and ignores them.
    """

    kq: Float[Constant, ""] | float = 10.0
    """Posture stiffness in the null space [1/s^2]."""

    def unguarded(
        self,
        arm: ArmState,
        setpoint: Setpoint,
        obstacles: Obstacles,
        tau_ext: Float[Array, " n"] | None,
        tau_last: Float[Array, " n"] | None,
    ) -> ControlOutput:
        """Torque for one state.

        It ignores the contacts' torque. The torque's rate is clipped where the robot
        has a limit of it.

        Returns:
            Torque, the acceleration it gives, that acceleration as an RMP in the
            inertia metric, and the diagnostics that all controllers have.
        """
        del obstacles, tau_ext
        Mq, bias = dynamics(self.robot, arm)
        site = site_state(self.robot, arm)
        kd_pos, kd_ori = (
            critical_damping(k) for k in (setpoint.kp_pos, setpoint.kp_ori)
        )
        a_pos = setpoint.kp_pos * (setpoint.p_des - site.p) - kd_pos * site.v
        error = orientation_error(site.R, setpoint.R_des)
        a_ori = setpoint.kp_ori * error - kd_ori * site.w

        J = jnp.concatenate([site.J_pos, site.J_ori])
        MinvJT = psd_solve(Mq, J.T)
        G = _dot(J, MinvJT)  # inverse of the operational inertia
        wrench = jnp.concatenate(
            [psd_solve(G[:3, :3], a_pos), psd_solve(G[3:, 3:], a_ori)]
        )
        qdd_0 = Posture(self.robot.q_home, kq=self.kq).acceleration(arm.q, arm.qd)
        null = _dot(Mq, qdd_0) - _dot(J.T, psd_solve(G, _dot(J, qdd_0)))
        dynamic = _dot(J.T, wrench) + null
        low, high = torque_range(self.robot, tau_last, self.period)
        tau, limit = clip_torque(dynamic + bias, low, high)
        return ControlOutput(
            tau=tau,
            qdd=psd_solve(Mq, dynamic),
            f=dynamic,
            M=Mq,
            Mq=Mq,
            bias=bias,
            diagnostics={"torque_limit": limit},
        )


def _dot(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")


class OSC(VICES):
    """VICES whose policy moves the set-point only.

    The stiffness entries of an action are ignored. Actions keep their size, so that the
    same policy network fits. The stiffness is that of robosuite's OSC_POSE controller.
    """

    kp: Float[Constant, ""] | float = 150.0
    """Stiffness in every direction [1/s^2]."""

    def decode(self, action: Float[ArrayLike, " m"]) -> Action:
        """Physical units of a policy action in [-1, 1]^m."""
        free = super().decode(action)
        held = jnp.full_like(free.kp_pos, self.kp)
        return free.replace(kp_pos=held, kp_ori=held)
