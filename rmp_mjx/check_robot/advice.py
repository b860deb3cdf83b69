"""What does not fit about an arm, and which parameter to turn."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rmp_mjx.check_robot.certificate import ENOUGH
from rmp_mjx.check_robot.coverage import LinkCoverage
from rmp_mjx.check_robot.reaches import (
    DURATION,
    FROM_END,
    PERIOD,
    Draws,
    Track,
    greatest,
    reach_of,
)
from rmp_mjx.control import Leaves
from rmp_mjx.robot import Robot
from rmp_mjx.robot.configurations import capsule_gaps
from rmp_mjx.robot.limits import recorded

THICK = 2.6
"""A link's capsules are called thick from this many times its hull's volume."""

MANY = 150
"""Control points above which a call gets slow."""


def about_model(
    robot: Robot, errors: dict[str, dict[str, float]], links: list[LinkCoverage]
) -> Iterator[str]:
    """Findings about the arm itself, one sentence each."""
    for engine, terms in errors.items():
        for name, error in terms.items():
            if not error < ENOUGH:
                yield f"{name} differs from {engine}'s by {error:.1e} of its size"
    for link in links:
        if link.ratio > THICK:
            yield (
                f"the capsules of {link.body} have {link.ratio:.1f} times its hull's "
                "volume: split its mesh into convex parts"
            )
    home = np.asarray(robot.q_home)
    for j, name in enumerate(robot.joint_names):
        if min(home[j] - robot.q_lower[j], robot.q_upper[j] - home[j]) < FROM_END:
            yield f"q_home puts joint {name} within {FROM_END} of its range's end"
    if robot.capsules.pairs:
        gaps = capsule_gaps(robot, home[None], robot.capsules.pairs)[0]
        far, near = robot.capsules.pairs[int(np.argmin(gaps))]
        if gaps.min() < 0.02:
            names = robot.capsules.geom[far], robot.capsules.geom[near]
            yield (
                f"at q_home {names[0]} and {names[1]} are {1000 * gaps.min():.0f} mm "
                "apart: choose another q_home"
            )
    light = [
        n for n, a in zip(robot.joint_names, robot.armature, strict=True) if a <= 0
    ]
    if light:
        yield (
            f"no rotor inertia at {', '.join(light)}: geared joints have some, give "
            "armature="
        )
    count = len(robot.points.segment)
    if count > MANY:
        yield f"{count} control points: a greater spacing= makes the controller faster"
    collision = Leaves.default(robot).collision
    distance, reach = float(getattr(collision, "r", 0.0)), reach_of(robot)
    if not 0.1 < distance / reach < 0.5:
        yield (
            f"the collision leaf acts from {distance:g} m on, the arm's reach is "
            f"{reach:.2f} m: give leaves= with a collision leaf of another r"
        )


def about_motion(robot: Robot, draws: Draws, track: Track) -> Iterator[str]:
    """Findings about the reaches, one sentence each."""
    reached = track.nearest < draws.radius
    if not np.all(np.isfinite(track.speed)):
        yield "a simulation blew up: look at the rotor inertias (armature=)"
    free = float(np.mean(reached[~draws.blocked]))
    blocked = float(np.mean(reached[draws.blocked]))
    if free < 0.9:
        yield (
            f"only {free:.0%} of the reaches without a sphere arrive: look at the "
            "torque limits and the friction"
        )
    elif blocked < free - 0.1:
        yield (
            f"{blocked:.0%} arrive with a sphere in the way, {free:.0%} without: try "
            "thinner capsules, or a smaller r and margin of the collision leaf"
        )
    count = np.count_nonzero(track.touched)
    if count > 0.01 * len(reached):
        yield (
            f"{count} contacts: stay further away with collision_transit(), or give "
            "velocity_limits="
        )
    if np.any(track.crossed):
        yield f"{np.count_nonzero(track.crossed)} reaches end in self-collision"
    for j in np.flatnonzero(track.room.min(axis=0) < FROM_END):
        yield f"joint {robot.joint_names[j]} came within {FROM_END} of its range's end"
    if robot.qd_max is None:
        speeds = ", ".join(f"{v:.1f}" for v in greatest(track.speed))
        yield (
            f"no velocity limits are known, and the joints ran at up to {speeds}: give "
            "velocity_limits= from the data sheet"
        )
    elif np.any(greatest(track.speed) > 1.1 * robot.qd_max):
        yield "a joint ran at more than 1.1 of its velocity limit"
    limit = recorded(robot.mj_model).get("acceleration_limits")
    if limit is not None and np.any(greatest(track.acceleration) > 1.1 * limit):
        most = np.max(greatest(track.acceleration) / limit)
        yield (
            f"joints accelerate with up to {most:.1f} times the file's limit, which no "
            "controller keeps: lower torque_rate_limits= and stiffness help"
        )
    if robot.tau_rate_max is None:
        yield "no limits of the torques' rates are known: give torque_rate_limits="
    if float(np.mean(track.limited)) > 0.1 * DURATION / PERIOD:
        yield "the motors are at their limits in more than a tenth of the time"
