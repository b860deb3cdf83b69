"""The safety record: contacts, forces and joint limits, step by step."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from envs.scene import Scene
from rmp_mjx.pytree import Pytree
from rmp_mjx.robot import Robot
from rmp_mjx.sim import PhysicsState, read_contacts

LIMIT_MARGIN = 0.1
"""A joint nearer than this to a limit is a joint-limit event [rad] (VICES)."""

TURN = 2 * jnp.pi
"""robosuite's limit for the continuous joints [rad]."""

REVERSAL = 1.0
"""A torque that turns round by more than this both ways counts as a reversal [N m]."""

EVENTS = (
    "collision",
    "arm_collision",
    "obstacle_collision",
    "self_collision",
    "joint_limit",
    "turn_limit",
)
"""Flags of a record that are counted when they begin."""

NUMBERS = (
    "force",
    "force_peak",
    "work_force",
    "work_force_peak",
    "saturation",
    "torque_jump",
    "reversals",
    "jerk",
)
"""Its numbers."""


class SafetyRecord(Pytree):
    """What happened during one policy step (or one physics step)."""

    collision: Bool[Array, ""]
    """A link or the hand touched what it must not: table, fixture, obstacle, or, for a
    link, the object the hand works with."""
    arm_collision: Bool[Array, ""]
    """The same without the hand."""
    obstacle_collision: Bool[Array, ""]
    """A link or the hand touched a sphere."""
    self_collision: Bool[Array, ""]
    """Two links touched."""
    joint_limit: Bool[Array, ""]
    """A limited joint within 0.1 rad of its range's end."""
    turn_limit: Bool[Array, ""]
    """A continuous joint within 0.1 rad of +-2 pi."""
    force: Float[Array, ""]
    """Sum of the normal forces of collisions [N], mean over the physics steps."""
    force_peak: Float[Array, ""]
    """Greatest of them on one geom pair [N]."""
    work_force: Float[Array, ""]
    """Sum of the normal forces between hand and object [N], mean."""
    work_force_peak: Float[Array, ""]
    """Greatest such sum [N]."""
    saturation: Float[Array, ""]
    """Share of the physics steps with a torque at its limit."""
    torque_jump: Float[Array, ""]
    """Largest change of a torque from one physics step to the next [N m]."""
    reversals: Float[Array, ""]
    """Share of the physics steps in which a torque turns round."""
    jerk: Float[Array, ""]
    """Largest jerk of a joint from one physics step to the next [rad/s^3]."""
    overflow: Bool[Array, ""]
    """A geom pair had more contacts than were read."""

    @staticmethod
    def none() -> SafetyRecord:
        """The record of no time at all."""
        no, zero = jnp.zeros((), bool), jnp.zeros(())
        numbers = dict.fromkeys(NUMBERS, zero)
        return SafetyRecord(**dict.fromkeys(EVENTS, no), **numbers, overflow=no)

    @property
    def event(self) -> Bool[Array, ""]:
        """Whether anything happened that ends an episode."""
        return self.collision | self.self_collision | self.joint_limit

    @property
    def flags(self) -> dict[str, Bool[Array, ""]]:
        """The `EVENTS` by name."""
        return {name: getattr(self, name) for name in EVENTS}

    def then(self, step: SafetyRecord, share: float) -> SafetyRecord:
        """This record extended by one physics step that is `share` of the whole."""
        flags = {name: on | getattr(step, name) for name, on in self.flags.items()}
        return SafetyRecord(
            **flags,
            force=self.force + share * step.force,
            force_peak=jnp.maximum(self.force_peak, step.force_peak),
            work_force=self.work_force + share * step.work_force,
            work_force_peak=jnp.maximum(self.work_force_peak, step.work_force_peak),
            saturation=self.saturation + share * step.saturation,
            torque_jump=jnp.maximum(self.torque_jump, step.torque_jump),
            reversals=self.reversals + share * step.reversals,
            jerk=jnp.maximum(self.jerk, step.jerk),
            overflow=self.overflow | step.overflow,
        )


class Torques(Pytree):
    """Torques of the last physics steps: what their smoothness is read from."""

    tau: Float[Array, " n"]
    """Torques [N m]."""
    change: Float[Array, " n"]
    """Their change in the last step [N m]."""
    back: Bool[Array, ""]
    """Whether one of them turned round in it."""
    first: Bool[Array, ""]
    """Whether there is no step yet."""

    @staticmethod
    def none(n: int) -> Torques:
        """Before the first step with a new set-point: its jump is the policy's."""
        zero = jnp.zeros(n)
        return Torques(zero, zero, jnp.zeros((), bool), jnp.ones((), bool))

    def then(self, tau: Float[Array, " n"]) -> Torques:
        """One step on."""
        change = jnp.where(self.first, 0.0, tau - self.tau)
        turned = change * self.change < 0
        large = jnp.minimum(jnp.abs(change), jnp.abs(self.change)) > REVERSAL
        return Torques(tau, change, jnp.any(turned & large), jnp.zeros((), bool))


class Motion(Pytree):
    """Velocities of the last physics steps: what the joints' jerk is read from."""

    qd: Float[Array, " n"]
    """Joint velocities [rad/s]."""
    qdd: Float[Array, " n"]
    """Their change in the last step, over its time [rad/s^2]."""
    jerk: Float[Array, " n"]
    """The change of that, over the time of a step [rad/s^3]."""
    first: Bool[Array, ""]
    """Whether there is no step yet."""

    @staticmethod
    def none(qd: Float[Array, " n"]) -> Motion:
        """Before the first step with a new set-point: its jerk is the policy's."""
        zero = jnp.zeros_like(qd)
        return Motion(qd, zero, zero, jnp.ones((), bool))

    def then(self, qd: Float[Array, " n"], dt: float) -> Motion:
        """One step of `dt` [s] on."""
        qdd = (qd - self.qd) / dt
        jerk = jnp.where(self.first, 0.0, (qdd - self.qdd) / dt)
        return Motion(qd, qdd, jerk, jnp.zeros((), bool))


def observe(
    scene: Scene,
    robot: Robot,
    state: PhysicsState,
    torques: Torques,
    motion: Motion,
    torque_scale: Float[Array, ""],
) -> SafetyRecord:
    """The record of the physics step that led to `state`."""
    contacts = read_contacts(scene.model, state)
    q = state.qpos[: robot.n]
    near_lower = q - robot.q_lower < LIMIT_MARGIN
    near_upper = robot.q_upper - q < LIMIT_MARGIN
    free = ~jnp.isfinite(robot.q_upper) & jnp.asarray(robot.hinge)
    work = jnp.sum(jnp.where(scene.work, contacts.force, 0.0))
    unwanted = jnp.where(scene.work, 0.0, contacts.force)
    return SafetyRecord(
        collision=jnp.any(contacts.touching & (scene.hand | scene.arm)),
        arm_collision=jnp.any(contacts.touching & scene.arm),
        obstacle_collision=jnp.any(contacts.touching & scene.obstacle),
        self_collision=jnp.any(contacts.touching & scene.own),
        joint_limit=jnp.any(near_lower | near_upper),
        turn_limit=jnp.any(free & (jnp.abs(q) > TURN - LIMIT_MARGIN)),
        force=jnp.sum(unwanted),
        force_peak=jnp.max(unwanted, initial=0.0),
        work_force=work,
        work_force_peak=work,
        saturation=(torque_scale < 1.0).astype(q.dtype),
        torque_jump=jnp.max(jnp.abs(torques.change)),
        reversals=torques.back.astype(q.dtype),
        jerk=jnp.max(jnp.abs(motion.jerk)),
        overflow=jnp.any(contacts.overflow),
    )
