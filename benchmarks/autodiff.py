"""RMP-VICES evaluated by autodiff of its tree, as a controller to compare with."""

from __future__ import annotations

import jax.numpy as jnp

import rmp_mjx as rmp
from rmp_mjx.control.torque import scale_torque
from rmp_mjx.control.tree import rmp_vices_tree
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state


class AutodiffRMPVICES(rmp.RMPVICES):
    """The definition of the controller, at time 0 of the set-point: without dither."""

    def __call__(self, q, qd, setpoint, obstacles):
        """Torque for one state.

        The weight of the orientation is the closed form's. Compiled, nothing else of
        that is left.
        """
        out = super().__call__(q, qd, setpoint, obstacles)
        q, qd = jnp.asarray(q), jnp.asarray(qd)
        Mq, bias = dynamics(self.robot, arm_state(self.robot, q, qd))
        tree = rmp_vices_tree(
            self.robot,
            self.leaves,
            setpoint,
            obstacles,
            Mq,
            self.attractor_weight,
            out.diagnostics["orientation_weight"],
        )
        root = rmp.evaluate(tree, q, qd)
        qdd = rmp.resolve(root, self.regularizer * Mq)
        dynamic = jnp.matmul(Mq, qdd, precision="highest")
        tau, scale = scale_torque(dynamic, bias, jnp.asarray(self.robot.tau_max))
        diagnostics = out.diagnostics | {"torque_scale": scale}
        return rmp.ControlOutput(tau, qdd, root.f, root.M, diagnostics)
