"""Serial arms that nobody designed: random joints, axes, lengths, masses and motors."""

from __future__ import annotations

import warnings

import numpy as np

import rmp_mjx as rmp
from rmp_mjx.robot import RobotWarning

SLIDES = 0.2
"""Share of slides among the joints after the first one."""

JOINTS = (4, 9)
"""Least and greatest number of joints."""

LIFT = 3.0
"""A motor's torque over what holds the stretched arm behind it."""


def random_chain(seed: int, joints: int | None = None) -> rmp.Robot:
    """A chain of capsules from 0.4 to 1.3 m long.

    Axes point anywhere. The first joint is a hinge without limits; the others are
    hinges of plus and minus 2 rad, or slides of 50 cm. Links have water's density.

    Args:
        seed: Names the chain.
        joints: Their number; None: drawn from `JOINTS`.
    """
    rng = np.random.default_rng(seed)
    low, high = JOINTS
    n = int(rng.integers(low, high + 1)) if joints is None else joints
    lengths = rng.dirichlet(np.full(n, 4.0)) * rng.uniform(0.4, 1.3)
    lengths = np.maximum(lengths, 0.05)
    radii = rng.uniform(0.02, 0.04, n)
    masses = 1e3 * np.pi * radii**2 * (lengths + 4.0 / 3.0 * radii)
    slides = rng.uniform(size=n) < SLIDES
    slides[0] = False
    axes = rng.normal(size=(n, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    body, motors = f'<site name="tip" pos="0 0 {lengths[-1]}"/>', ""
    for j in reversed(range(n)):
        reach = np.cumsum(lengths[j:]) - 0.5 * lengths[j:]
        weight = 9.81 * masses[j:]
        load = weight.sum() if slides[j] else np.sum(weight * reach)
        limit = LIFT * load + 1.0
        kind, ends, rotor = "hinge", 'range="-2 2"', 0.02 * reach[-1] + 0.01
        if slides[j]:
            kind, ends, rotor = "slide", 'range="0 .5"', 1.0
        axis, at = " ".join(map(str, axes[j])), lengths[j - 1] if j else 0.1
        body = f"""<body name="link_{j}" pos="0 0 {at}">
          <joint name="j{j}" type="{kind}" axis="{axis}" {ends if j else ""}
                 armature="{rotor}"/>
          <geom type="capsule" fromto="0 0 0 0 0 {lengths[j]}" size="{radii[j]}"
                mass="{masses[j]}"/>
          {body}</body>"""
        motors += f'<motor joint="j{j}" ctrlrange="-{limit} {limit}"/>'
    text = f"""<mujoco><compiler angle="radian"/><worldbody>{body}</worldbody>
    <actuator>{motors}</actuator></mujoco>"""
    speeds = np.where(slides, 0.5, 2.5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RobotWarning)  # q_home is searched
        return rmp.Robot.from_mjcf(
            text, site="tip", spacing=0.05, velocity_limits=speeds
        )
