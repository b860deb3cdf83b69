"""The objects of a task in the live view: its door, its block."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rmp_mjx import runtime
from rmp_mjx.robot import Robot
from rmp_mjx.viewer.objects import Objects

from . import registry
from .scene import ASSETS, TABLE_HEIGHT


def scene(task: str, robot: str) -> tuple[Robot, Objects]:
    """An arm where it stands in a task, and the task's objects.

    Args:
        task: Name of a task.
        robot: Name of an arm, or path of its model.

    Raises:
        ValueError: There is no such task, or the arm does not reach what it asks for.
    """
    runtime.configure()
    env = registry.load(task, robot=robot, physics="mujoco")

    def attach(spec: mujoco.MjSpec) -> None:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        env.objects(spec)
        standing = {name for name, _, _ in contacts.passive}
        for name in (*contacts.fixtures, *contacts.work):
            geom = spec.geom(name)
            geom.contype, geom.conaffinity = int(name in standing), 1
            if name in contacts.work:
                geom.friction[0], geom.priority = contacts.work_friction, 1

    contacts = env.objects(mujoco.MjSpec.from_file(str(ASSETS / "arena.xml")))
    start = env.begin(jax.random.key(0), jnp.asarray(env.robot.q_home))
    return env.robot, Objects(
        attach,
        (*contacts.fixtures, *contacts.work),
        frozenset(contacts.work),
        np.asarray(start[0], float),
        TABLE_HEIGHT,
    )
