"""What a robot is told of a task, since an arm does not measure it: by name.

The objects' joints by their names in MuJoCo, `hinge` or `block`: an angle or a pose, as
`qpos` has it; and `hinge_rate` or `block_rate`, as `qvel` has them. Besides the task's
own state, `goal` say. What a program does not use of these is not asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from rmp_mjx.deploy.programs import Program
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.robot.kinematics import arm_state, site_state
from rmp_mjx.sim import PhysicsState

from .base import ArmEnv
from .types import State

Told = dict[str, Any]
"""Arrays by name."""


def observe_program(env: ArmEnv, slots: Mapping[str, Any]) -> Program | None:
    """The observation from (q, qd, told, obstacles); None where it takes more."""

    def observe(q, qd, data: PhysicsState, told: Told, obstacles: Any):
        site = site_state(env.robot, arm_state(env.robot, q, qd))
        spheres = Obstacles.empty().spheres
        spheres = spheres.replace(**obstacles.get("spheres", {}))
        values = env.observe(data, site, told)
        return env.assemble(site, q, values, lambda: spheres)

    return _program(env, observe, slots)


def fixtures_program(env: ArmEnv) -> Program | None:
    """The task's objects as obstacles, from what is told; None: there are none."""
    if not env.fixture_slots:
        return None

    def fixtures(q, qd, data: PhysicsState, told: Told):
        slots = env.fixtures(Obstacles.empty(**env.fixture_slots), data)
        found = {name: dict(vars(getattr(slots, name))) for name in env.fixture_slots}
        return {
            name: {key: x for key, x in fields.items() if key != "active"}
            for name, fields in found.items()
        }

    found = _program(env, fixtures)
    if found is None:
        return None
    program, (q, qd, told) = found
    return lambda told: program(q, qd, told), (told,)


def _program(
    env: ArmEnv, function: Callable[..., Any], *others: Mapping[str, Any]
) -> Program | None:
    """A function of (q, qd, physics, told) as one of (q, qd, told).

    None: it takes more of the physics than the joints.
    """
    example = jax.eval_shape(lambda key: _parts(env.reset(key)), jax.random.key(0))
    data, task = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), example)
    joints = _joints(env)
    known = {name: getattr(data, field)[at] for name, (field, at) in joints.items()}
    known |= task

    def called(q, qd, told, *rest, data=data):
        told = known | told
        fields = {"qpos": q, "qvel": qd}
        for name, (field, _) in joints.items():
            fields[field] = jnp.append(fields[field], told[name])
        own = {name: told[name] for name in task}
        return function(q, qd, data.replace(**fields), own, *rest)

    def whole(data, told, q, qd, *rest):
        return called(q, qd, told, *rest, data=data)

    zero = jnp.zeros(env.robot.n)
    traced = export.export(jax.jit(whole))(data, known, zero, zero, *others)
    physics, kept = len(jax.tree.leaves(data)), traced.module_kept_var_idx
    if kept and kept[0] < physics:
        return None
    used = [name for k, name in enumerate(sorted(known)) if physics + k in kept]
    return called, (zero, zero, {name: known[name] for name in used}, *others)


def _parts(state: State) -> tuple[PhysicsState, Told]:
    return state.data, state.task


def _joints(env: ArmEnv) -> dict[str, tuple[str, int | slice]]:
    """Where the joints of the objects are in a state, by name, in their order."""
    model, found = env.scene.model, {}
    for joint in map(model.joint, range(model.njnt)):
        if joint.qposadr[0] >= env.robot.n:
            name = joint.name.split("/")[-1]
            found[name] = "qpos", _at(joint.qposadr, joint.qpos0)
            found[f"{name}_rate"] = "qvel", _at(joint.dofadr, joint.damping)
    return found


def _at(first: np.ndarray, values: np.ndarray) -> int | slice:
    """Where a joint's values are; one is a number."""
    k = int(first[0])
    return k if len(values) == 1 else slice(k, k + len(values))
