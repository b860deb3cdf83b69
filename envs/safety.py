"""The safety record: contacts, forces, joint limits and smoothness of every step."""

from __future__ import annotations

import dataclasses
import functools
import operator
from typing import Any, Literal

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from rmp_mjx.metric import Metric, of_fields
from rmp_mjx.pytree import Pytree
from rmp_mjx.robot import Robot
from rmp_mjx.sim import PhysicsState, read_contacts
from rmp_mjx.types import Constant

from .scene import Scene

REVERSAL = 1.0
"""A torque reverses if it changes by more than this one way, then the other [N m]."""


class Torques(Pytree):
    """Torques of the last physics steps within a policy step."""

    tau: Float[Array, " n"]
    """Torques [N m]."""
    change: Float[Array, " n"]
    """Their change in the last step [N m]."""
    reversed: Bool[Array, ""]
    """Whether one of them reversed in the last step."""
    first: Bool[Array, ""]
    """Whether there is no step yet."""

    @staticmethod
    def start(n: int) -> Torques:
        """Before the first step. It counts as no change: the new set-point caused it.

        Args:
            n: Number of joints.
        """
        zero = jnp.zeros(n)
        return Torques(zero, zero, jnp.zeros((), bool), jnp.ones((), bool))

    def then(self, tau: Float[Array, " n"]) -> Torques:
        """After one more step with these torques [N m]."""
        change = jnp.where(self.first, 0.0, tau - self.tau)
        turned = change * self.change < 0
        large = jnp.minimum(jnp.abs(change), jnp.abs(self.change)) > REVERSAL
        return Torques(tau, change, jnp.any(turned & large), jnp.zeros((), bool))


class Motion(Pytree):
    """Joint velocities and accelerations of the last physics steps."""

    qd: Float[Array, " n"]
    """Joint velocities [rad/s]."""
    qdd: Float[Array, " n"]
    """Their change in the last step, divided by its time [rad/s^2]."""
    jerk: Float[Array, " n"]
    """Change of `qdd` in the last step, divided by its time [rad/s^3]."""
    first: Bool[Array, ""]
    """Whether there is no step yet."""

    @staticmethod
    def start(qd: Float[Array, " n"]) -> Motion:
        """Before the first step. It has no jerk: the new set-point caused it.

        Args:
            qd: Joint velocities [rad/s].
        """
        zero = jnp.zeros_like(qd)
        return Motion(qd, zero, zero, jnp.ones((), bool))

    def then(self, qd: Float[Array, " n"], dt: float) -> Motion:
        """After one more step of `dt` [s] that led to these velocities [rad/s]."""
        qdd = (qd - self.qd) / dt
        jerk = jnp.where(self.first, 0.0, (qdd - self.qdd) / dt)
        return Motion(qd, qdd, jerk, jnp.zeros((), bool))


ROUNDING = 1e-3
"""A speed or a rate beyond its limit by less than this share is at the limit."""

LIMIT_MARGIN = 0.1
"""A joint nearer than this to a limit is a joint-limit event [rad] (VICES)."""

ENDING = ("collision", "self_collision", "joint_limit")
"""Fields of `SafetyRecord`: events that end an episode."""

TURN = 2 * jnp.pi
"""robosuite's limit for the continuous joints [rad]."""

Fold = Literal["any", "mean", "max"]
"""How the physics steps of a policy step become one value."""


def recorded(fold: Fold, metric: Metric) -> Any:
    """A field of `SafetyRecord`: how it folds, and the metric that it is."""
    return struct.field(metadata={"fold": fold, "metric": metric})


def _event(name: str, label: str = "", headline: str = "", shown: bool = False) -> Any:
    """A flag that is counted when it begins, and may be in an evaluation's table."""
    table = ("rate",) if shown else ()
    metric = Metric(name, "sum", label, event=True, headline=headline, table=table)
    return recorded("any", metric)


class SafetyRecord(Pytree):
    """What happened during one physics step, or during one policy step.

    Each field declares its metric and how the physics steps of a policy step fold. A
    flag whose metric is an event counts when it begins: one that is still set at the
    next step counts once.
    """

    collision: Bool[Array, ""] = _event("collision", headline="coll", shown=True)
    """A link or the hand touched what it must not: table, fixture, obstacle, or, for a
    link, the object that the hand may touch."""
    arm_collision: Bool[Array, ""] = _event("arm_collision")
    """The same without the hand."""
    obstacle_collision: Bool[Array, ""] = _event("obstacle_collision")
    """A link or the hand touched a sphere."""
    at_fault: Bool[Array, ""] = _event("at_fault", "at-fault contact", shown=True)
    """A collision began while the arm's own speed towards the other body was above
    1 cm/s; the other body's motion does not count (`envs.impacts`)."""
    self_collision: Bool[Array, ""] = _event(
        "self_collision", "self-collision", shown=True
    )
    """Two links touched."""
    joint_limit: Bool[Array, ""] = _event("joint_limit", headline="limit", shown=True)
    """A limited joint within 0.1 rad of its range's end."""
    turn_limit: Bool[Array, ""] = _event("turn_limit")
    """A continuous joint within 0.1 rad of +-2 pi."""
    joint_velocity: Bool[Array, ""] = _event("joint_velocity")
    """A joint faster than the robot's `qd_max`, if it has one. It ends no episode."""
    torque_rate: Bool[Array, ""] = _event("torque_rate")
    """A torque that changed faster than the robot's `tau_rate_max`, if it has one. It
    ends no episode."""
    contact_force: Float[Array, ""] = recorded(
        "mean", Metric("contact_force", "mean", unit="N")
    )
    """Sum of the normal forces of collisions [N]."""
    contact_force_peak: Float[Array, ""] = recorded(
        "max",
        Metric("contact_force_peak", "max", "contact peak", "N", table=("max",)),
    )
    """Greatest of them on one pair of geoms [N]."""
    contact_speed: Float[Array, ""] = recorded(
        "max", Metric("contact_speed", "max", unit="m/s", table=("max",))
    )
    """Greatest own speed of the arm towards the other body as a collision began
    [m/s]."""
    closing_speed: Float[Array, ""] = recorded(
        "max", Metric("closing_speed", "max", unit="m/s")
    )
    """Greatest speed of the two towards each other as a collision began [m/s]."""
    contact_energy: Float[Array, ""] = recorded(
        "max", Metric("contact_energy", "max", unit="J", table=("max",))
    )
    """Energy of the arm's own motion along the normal, with the arm's effective mass,
    of the collision that began with the greatest own speed in a policy step [J]."""
    work_force: Float[Array, ""] = recorded(
        "mean", Metric("work_force", "mean", unit="N", table=("mean",))
    )
    """Sum of the normal forces between the hand and the object it may touch [N]."""
    work_force_peak: Float[Array, ""] = recorded(
        "max", Metric("work_force_peak", "max", "work peak", "N")
    )
    """Greatest such sum [N]."""
    torque_saturation: Float[Array, ""] = recorded(
        "mean",
        Metric("torque_saturation", "mean", "saturation", "share", table=("mean",)),
    )
    """Share of the physics steps with a torque at its limit."""
    torque_jump: Float[Array, ""] = recorded(
        "max", Metric("torque_jump", "max", unit="N m")
    )
    """Greatest change of a torque from one physics step to the next [N m]."""
    torque_slope: Float[Array, ""] = recorded(
        "max", Metric("torque_slope", "max", unit="N m/s")
    )
    """Greatest rate of change of a torque from one physics step to the next
    [N m/s]."""
    torque_reversals: Float[Array, ""] = recorded(
        "mean", Metric("torque_reversals", "mean", unit="share")
    )
    """Share of the physics steps in which a torque reverses, as in an oscillation."""
    joint_speed: Float[Array, ""] = recorded(
        "max", Metric("joint_speed", "max", unit="rad/s", table=("max",))
    )
    """Greatest speed of a joint [rad/s]."""
    joint_jerk: Float[Array, ""] = recorded(
        "max", Metric("joint_jerk", "max", unit="rad/s^3")
    )
    """Greatest jerk of a joint from one physics step to the next [rad/s^3]."""
    guard_used: Float[Array, ""] = recorded(
        "mean", Metric("guard_used", "mean", unit="share")
    )
    """Share of the torques that was the guard's stop; 0 without a guard."""
    guard_unproved: Float[Array, ""] = recorded(
        "mean", Metric("guard_unproved", "mean", unit="share")
    )
    """Share of the physics steps in which the guard had no proof, since an assumption
    did not hold: no stop was proved, or the step was not as predicted."""
    contact_overflow: Bool[Array, ""] = recorded(
        "any",
        Metric(
            "contact_overflow",
            "max",
            fault="a pair of bodies had more contacts than are read: forces too low",
        ),
    )
    """A pair of geoms had more contacts than were read."""

    @staticmethod
    def empty() -> SafetyRecord:
        """The record of no steps."""
        no, zero = jnp.zeros((), bool), jnp.zeros(())
        return SafetyRecord(
            **{name: no if fold == "any" else zero for name, fold in FOLDS.items()}
        )

    @property
    def event(self) -> Bool[Array, ""]:
        """Whether anything happened that ends an episode."""
        return functools.reduce(operator.or_, (getattr(self, n) for n in ENDING))

    @property
    def events(self) -> dict[str, Bool[Array, ""]]:
        """The flags that are counted when they begin, by name."""
        return {n: getattr(self, n) for n, metric in METRICS.items() if metric.event}

    @property
    def values(self) -> dict[str, Array]:
        """Everything else, by name."""
        names = (n for n, metric in METRICS.items() if not metric.event)
        return {name: getattr(self, name) for name in names}

    def then(self, step: SafetyRecord, share: float) -> SafetyRecord:
        """This record extended by one physics step.

        Args:
            step: The record of that step.
            share: The step's share of the policy step.
        """

        def extended(name: str, fold: Fold) -> Array:
            old, new = getattr(self, name), getattr(step, name)
            if fold == "any":
                return old | new
            return jnp.maximum(old, new) if fold == "max" else old + share * new

        return SafetyRecord(**{n: extended(n, fold) for n, fold in FOLDS.items()})


FOLDS: dict[str, Fold] = {
    field.name: field.metadata["fold"] for field in dataclasses.fields(SafetyRecord)
}
"""How each field folds, by name."""
METRICS = of_fields(SafetyRecord)
"""The metric of each field, by name."""


def observe(
    scene: Scene,
    robot: Robot,
    state: PhysicsState,
    torques: Torques,
    motion: Motion,
    torque_limit: Float[Array, " n"],
    change: Float[Array, " n"] | None = None,
    guarded: tuple[Array, Array] | None = None,
) -> SafetyRecord:
    """The record of the physics step that led to `state`.

    Args:
        scene: The scene.
        robot: The arm.
        state: Physics after the step.
        torques: Torques up to this step.
        motion: Velocities up to this step.
        torque_limit: Not 0 where a torque was at its limit, (n,).
        change: Change of the applied torques in this step, the first of a policy step
            included, (n,) [N m]; for an arm with a limit on their rate.
        guarded: Share of the guard's stop, and whether the guard had no proof; None
            without a guard.

    Returns:
        The record; what is measured of collisions is for `impacts` to add.
    """
    timestep = scene.model.opt.timestep
    contacts = read_contacts(scene.model, state)
    q = state.qpos[: robot.n]
    near_lower = q - robot.q_lower < LIMIT_MARGIN
    near_upper = robot.q_upper - q < LIMIT_MARGIN
    free = ~jnp.isfinite(robot.q_upper) & jnp.asarray(robot.hinge)
    work = jnp.sum(jnp.where(scene.work, contacts.force, 0.0))
    unwanted = jnp.where(scene.work, 0.0, contacts.force)
    zero = jnp.zeros_like(work)
    return SafetyRecord(
        collision=jnp.any(contacts.touching & (scene.hand | scene.arm)),
        arm_collision=jnp.any(contacts.touching & scene.arm),
        obstacle_collision=jnp.any(contacts.touching & scene.obstacle),
        self_collision=jnp.any(contacts.touching & scene.self_pairs),
        joint_limit=jnp.any(near_lower | near_upper),
        turn_limit=jnp.any(free & (jnp.abs(q) > TURN - LIMIT_MARGIN)),
        at_fault=jnp.zeros((), bool),
        joint_velocity=_beyond(motion.qd, robot.qd_max),
        torque_rate=_beyond(
            None if change is None else change / timestep, robot.tau_rate_max
        ),
        contact_force=jnp.sum(unwanted),
        contact_force_peak=jnp.max(unwanted, initial=0.0),
        contact_speed=zero,
        closing_speed=zero,
        contact_energy=zero,
        work_force=work,
        work_force_peak=work,
        torque_saturation=jnp.any(torque_limit != 0.0).astype(q.dtype),
        torque_jump=jnp.max(jnp.abs(torques.change)),
        torque_slope=jnp.max(jnp.abs(torques.change)) / timestep,
        torque_reversals=torques.reversed.astype(q.dtype),
        joint_speed=jnp.max(jnp.abs(motion.qd)),
        joint_jerk=jnp.max(jnp.abs(motion.jerk)),
        guard_used=zero if guarded is None else guarded[0].astype(q.dtype),
        guard_unproved=zero if guarded is None else guarded[1].astype(q.dtype),
        contact_overflow=jnp.any(contacts.overflow),
    )


def _beyond(
    value: Float[Array, " n"] | None, limit: Float[Constant, " n"] | None
) -> Bool[Array, ""]:
    """Whether an entry is beyond its limit by more than rounding; no limit: never."""
    if value is None or limit is None:
        return jnp.zeros((), bool)
    return jnp.any(jnp.abs(value) > (1.0 + ROUNDING) * jnp.asarray(limit, value.dtype))
