"""frax and CBFpy: operational-space torque control of a 7-DOF arm, bare and filtered.

``osc`` is an operational-space impedance controller with a null-space posture on frax's
Franka Panda, from one call of its `torque_control_matrices`: the counterpart of our
VICES. ``osc_cbf`` sends it through CBFpy's safety filter, a quadratic program over the
torques with second-order barriers for every collision sphere of the arm against five
obstacle spheres and for the joint limits: the counterpart of our RMP-VICES. The arms,
the numbers of spheres (frax's own model of the Panda) and the notions of safety differ.
The problem (safe torques from a joint state, set-point and obstacles) is the same.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from cbfpy import CBF, CBFConfig  # pyright: ignore[reportMissingImports]
from frax.robots.franka_panda import (  # pyright: ignore[reportMissingImports]
    default_q,
    load_panda,
)

from benchmarks.peers.worker import Measure, latency, rate, serve

N = 7
BATCH = 2048
TORQUE_LIMIT = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])


def osc(robot, q, qd, p_des, R_des, kp):
    """Torques of operational-space impedance control with a posture."""
    M, Minv, G, C, J, T = robot.torque_control_matrices(q, qd)
    error = 0.5 * jnp.sum(jnp.cross(T[:3, :3], R_des, axis=0), axis=1)
    twist = J @ qd
    wanted = kp * jnp.concatenate([p_des - T[:3, 3], error])
    wanted = wanted - 2.0 * jnp.sqrt(kp) * twist
    inertia = jnp.linalg.inv(J @ Minv @ J.T)
    posture = M @ (10.0 * (default_q - q) - 2.0 * jnp.sqrt(10.0) * qd)
    null = posture - J.T @ (inertia @ (J @ (Minv @ posture)))
    tau = J.T @ (inertia @ wanted) + null + C + G
    return jnp.clip(tau, -TORQUE_LIMIT, TORQUE_LIMIT)


class Torques(CBFConfig):
    """Torque control with barriers on obstacles and joint limits."""

    def __init__(self, robot, centers, radius):
        """State (q, qd), control tau."""
        self.robot, self.centers, self.radius = robot, centers, radius
        super().__init__(
            n=2 * N, m=N, u_min=-TORQUE_LIMIT, u_max=TORQUE_LIMIT, relax_qp=True
        )

    def f(self, z):
        """Drift of the arm."""
        q, qd = z[:N], z[N:]
        _, Minv, G, C, _, _ = self.robot.torque_control_matrices(q, qd)
        return jnp.concatenate([qd, -Minv @ (C + G)])

    def g(self, z):
        """Effect of the torques."""
        Minv = self.robot.mass_matrix_inverse(self.robot.mass_matrix(z[:N]))
        return jnp.concatenate([jnp.zeros((N, N)), Minv])

    def h_2(self, z):
        """Barriers of relative degree two: clearances and room to the limits."""
        q = z[:N]
        x, rho = self.robot.link_collision_data(q)
        gap = jnp.linalg.norm(x[:, None] - self.centers, axis=2)
        clear = (gap - rho[:, None] - self.radius).reshape(-1)
        return jnp.concatenate([clear, q - LOWER, UPPER - q])

    def alpha(self, h):
        """Gain of the barrier."""
        return 10.0 * h

    def alpha_2(self, h_2):
        """Gain of its rate."""
        return 10.0 * h_2


def states(batch: int):
    """Joint states within 90 % of the ranges, set-points near the hand, stiffness."""
    rng = np.random.default_rng(0)
    q = (LOWER + UPPER) / 2 + 0.45 * (UPPER - LOWER) * rng.uniform(-1, 1, (batch, N))
    qd = 0.5 * rng.standard_normal((batch, N))
    shift = rng.uniform(-0.05, 0.05, (batch, 3))
    kp = rng.uniform(10, 300, (batch, 6))
    return tuple(jnp.asarray(x, jnp.float32) for x in (q, qd, shift, kp))


def obstacles():
    """Five spheres in reach."""
    rng = np.random.default_rng(1)
    angle = rng.uniform(-np.pi, np.pi, 5)
    height = rng.uniform(0, 0.6, 5)
    centers = np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), height], axis=1)
    return jnp.asarray(centers, jnp.float32), 0.05


def controller(filtered: bool):
    """The torque of one state."""
    robot = load_panda()
    cbf = CBF.from_config(Torques(robot, *obstacles())) if filtered else None

    def torque(q, qd, shift, kp):
        T = robot.ee_transform(q)
        tau = osc(robot, q, qd, T[:3, 3] + shift, T[:3, :3], kp)
        if cbf is None:
            return tau
        return cbf.safety_filter(jnp.concatenate([q, qd]), tau)

    return torque


def throughput(filtered: bool) -> Measure:
    """Evaluations a second of a batch."""
    call, args = jax.jit(jax.vmap(controller(filtered))), states(BATCH)
    return rate(lambda: jax.block_until_ready(call(*args)), BATCH)


def single(filtered: bool) -> Measure:
    """Median time of one state [us]."""
    call, args = jax.jit(controller(filtered)), states(1)
    one = tuple(x[0] for x in args)
    return latency(lambda: jax.block_until_ready(call(*one)))


if __name__ == "__main__":
    serve(
        {
            "evals_osc": lambda: throughput(False),
            "evals_osc_cbf": lambda: throughput(True),
            "latency_osc": lambda: single(False),
            "latency_osc_cbf": lambda: single(True),
        },
        ("frax", "cbfpy", "jax", "numpy"),
    )
