"""Controller and policy as functions of plain arrays, and these as StableHLO.

Each takes and returns dictionaries of arrays with a leading batch of any size. Inside,
one state is computed after the other, exactly as the controller computes one state
alone: a robot has one, and gets that program.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax import export

from rmp_mjx.control import ContactObserver
from rmp_mjx.control.controller import ImpedanceController
from rmp_mjx.control.fail_safe import fall_back
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.robot.dynamics import holding_torque
from rmp_mjx.robot.kinematics import arm_state, site_state
from rmp_mjx.types import LeafWeights, Setpoint

PLATFORMS = ("cpu", "cuda")
"""What the programs are for."""

Program = tuple[Callable[..., Any], tuple[Any, ...]]
"""A function of one state, and examples of its arguments."""


def control_programs(
    controller: ImpedanceController,
    observer: ContactObserver | None,
    slots: Obstacles,
) -> dict[str, Program]:
    """What a loop calls of a controller.

    Args:
        controller: With the period of the loop.
        observer: What estimates the contacts' torque; None: nobody, it counts as zero.
        slots: Obstacles of the shapes that the robot will have.

    Returns:
        By name: `setpoint` of (q, action in [-1, 1], time); `control` of (q, qd,
        set-point, obstacles, memory), see `Deployed.control`; `grip` of (q, qd).
    """
    robot, n, period = controller.robot, controller.robot.n, controller.period
    zero, square = jnp.zeros(n), jnp.zeros((n, n))
    kinds = {name: vars(each) for name, each in vars(slots).items()}
    used = {
        name: dict(fields)
        for name, fields in kinds.items()
        if len(fields["active"])  # the kinds with slots
    }

    def setpoint(q, action, time):
        target = controller.setpoint(q, controller.decode(action), time)
        return _fields(target)

    def control(q, qd, target, obstacles, memory):
        world = Obstacles(
            **{
                name: type(getattr(slots, name))(**(obstacles.get(name) or fields))
                for name, fields in kinds.items()
            }
        )
        tau_ext = residual = jnp.zeros_like(q)
        if observer is not None:
            known = {k: v for k, v in memory.items() if k != "started"}
            before = observer.start(n).replace(started=memory["started"] > 0, **known)
            tau_ext, after = observer.estimate(before, qd, period)
            residual = after.tau_ext
        felt = None if observer is None else tau_ext
        out = controller(q, qd, _setpoint(target), world, felt, memory["tau"])
        arm = arm_state(robot, q, qd)
        return {
            "tau": out.tau,
            "brake": fall_back(robot, arm, out.Mq, out.bias),
            "gravity": holding_torque(robot, arm),
            "tau_ext": tau_ext,
            "clearance": out.diagnostics.get("clearance", jnp.asarray(jnp.inf)),
            "usable": out.diagnostics["usable"],
            "memory": {
                "qd": qd,
                "Mq": out.Mq,
                "bias": out.bias,
                "tau": out.tau,
                "tau_ext": residual,
                "started": jnp.ones(()),
            },
        }

    def grip(q, qd):
        site = site_state(robot, arm_state(robot, q, qd))
        return {"p": site.p, "R": site.R, "v": site.v, "w": site.w}

    action = jnp.zeros(controller.action_size)
    target = jax.eval_shape(setpoint, zero, action, jnp.zeros(()))
    memory = {"qd": zero, "Mq": square, "bias": zero, "tau": zero, "tau_ext": zero}
    memory["started"] = jnp.zeros(())
    return {
        "setpoint": (setpoint, (zero, action, jnp.zeros(()))),
        "control": (control, (zero, zero, target, used, memory)),
        "grip": (grip, (zero, zero)),
    }


def _fields(target: Setpoint) -> dict[str, Any]:
    """The fields of a set-point that are there, by name."""
    found: dict[str, Any] = {k: v for k, v in vars(target).items() if v is not None}
    if target.weights is not None:
        found["weights"] = dict(vars(target.weights))
    return found


def _setpoint(fields: Mapping[str, Any]) -> Setpoint:
    """The set-point of these fields."""
    weights = fields.get("weights")
    weights = None if weights is None else LeafWeights(**weights)
    return Setpoint(**{**fields, "weights": weights})


def serialise(program: Program) -> bytes:
    """A program as StableHLO for `PLATFORMS`, for batches of any size."""
    function, examples = program
    (batch,) = export.symbolic_shape("b")
    shapes = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct((batch, *x.shape), x.dtype), examples
    )

    def each(*arguments):
        return jax.lax.map(lambda one: function(*one), arguments)

    done = export.export(jax.jit(each), platforms=PLATFORMS)(*shapes)
    return bytes(done.serialize())


def serialised(programs: Mapping[str, Program]) -> dict[str, bytes]:
    """Programs by the name of their part."""
    return {f"{name}.stablehlo": serialise(each) for name, each in programs.items()}
