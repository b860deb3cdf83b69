"""The paper's controller and nothing else: formulas as printed, signs corrected."""

from __future__ import annotations

from rmp_mjx.control.leaves import Leaves
from rmp_mjx.control.rmp_vices import RMPVICES
from rmp_mjx.rmp.leaves.collision import PaperCollision
from rmp_mjx.rmp.leaves.joint_limit import RMPflowJointLimit
from rmp_mjx.robot.model import Robot

REGULARIZER = 1e-5
"""The root's epsilon. At 4,000 random states, some singular and some close to
obstacles, 99 % of the float32 accelerations are within 20 % of float64's (90 % within
6 %). At 1e-6 a tenth of them are wrong by most of their size."""


def rmp_vices_literal(robot: Robot) -> RMPVICES:
    r"""RMP-VICES with the formulas of the paper, their signs corrected, no additions.

    The two impedance attractors (metric 1, never relaxed), its collision leaf
    $m = \max(-\dot x, 0)^2 / x^4, \; a = -\eta \dot x$, and RMPflow's joint
    limiter at its authors' values. No posture leaf, no self-collision leaf, no
    curvature, floor, margin or range. It is a baseline: nothing in it resists a slow
    push, at rest the metric of its joint limiter is 0.01 everywhere, and its null space
    is undamped.

    What cannot be literal, and why:

    * Signs: as printed the attractor repels, the collision leaf acts on leaving and
      accelerates. The leaf's output is the force $f = m a$ that a pullback adds.
    * The root: $\ddot q = M^+ f$ jumps where the rank of M changes and in float32
      drops the attractors beside an obstacle. Instead we use the resolve of `RMPVICES`
      with the least power of ten that works in float32 (`REGULARIZER`).
    * $x^{-4}$ has no value at contact: x is clamped at 5 mm and the metric at
      1e5, the number in the authors' related code.
    * $\eta$ and the control points were not published: 2/s, from the range in
      the authors' related code, and a point every 5 cm or less on every link.

    Args:
        robot: The arm.

    Returns:
        A controller of the same kind as the default one, with other leaves.

    Source: Shaw et al., "RMPs for Safe Impedance Control in Contact-Rich Manipulation"
    (2021), section III; the limiter from Cheng et al., "RMPflow" (2018).
    """
    limiter = RMPflowJointLimit(robot.q_lower, robot.q_upper)
    return RMPVICES(
        robot,
        Leaves(collision=PaperCollision(), joint_limit=limiter),
        obstacle_relaxation=None,
        limit_relaxation=None,
        contact=None,
        dither=None,
        braking_share=None,
        regularizer=REGULARIZER,
    )
