"""What the tree thinks in a task, where a policy or a person acts."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.control import RMPVICES
from rmp_mjx.control.controller import ImpedanceController
from rmp_mjx.viewer.insight import Insight, think

from .base import ArmEnv
from .types import ControlMemory, State

UNKNOWN = ControlMemory(contact=None, tau=None)
"""Memory of a state that was kept without one."""


def thinker(
    env: ArmEnv,
) -> Callable[[State, Float[Array, " m"]], Insight] | None:
    """What the tree thinks of a state and the action that is taken in it, compiled.

    The tree is the task's controller, or the default one where that is none.

    Args:
        env: The task.

    Returns:
        The function; None: the task's controller takes no pose as its target.
    """
    controller, n = env.controller, env.robot.n
    if not isinstance(controller, ImpedanceController):
        return None
    tree = controller if isinstance(controller, RMPVICES) else RMPVICES(env.robot)

    @jax.jit
    def thought(state: State, action: Array) -> Insight:
        data, spheres = state.data, state.info["spheres"]
        q, qd = data.qpos[:n], data.qvel[:n]
        time = env.dt * state.info["step"]
        setpoint = controller.setpoint(q, controller.decode(action), time)
        memory = state.info.get("control", UNKNOWN)
        out, memory = env.control(data, spheres, setpoint, memory)
        felt = memory.contact.tau_ext if memory.contact else jnp.zeros(n)
        seen = env.obstacles(data, spheres)
        return think(tree, q, qd, out.qdd, setpoint, seen, felt)

    return thought
