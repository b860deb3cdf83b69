"""The safety record: contacts and joint limits, step by step."""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from envs.scene import Scene
from rmp_mjx.robot import Robot
from rmp_mjx.sim import PhysicsState, read_contacts

LIMIT_MARGIN = 0.1
"""A joint nearer than this to a limit is a joint-limit event [rad] (VICES)."""

TURN = 2 * jnp.pi
"""robosuite's limit for the continuous joints [rad]."""


@struct.dataclass
class SafetyRecord:
    """What happened during one policy step (or one physics step)."""

    collision: Bool[Array, ""]
    """A link or the hand touched the table or an obstacle."""
    arm_collision: Bool[Array, ""]
    """The same without the hand."""
    self_collision: Bool[Array, ""]
    """Two links touched."""
    joint_limit: Bool[Array, ""]
    """A limited joint within 0.1 rad of its range's end."""
    turn_limit: Bool[Array, ""]
    """A continuous joint within 0.1 rad of +-2 pi."""
    force: Float[Array, ""]
    """Sum of the normal forces on the arm [N], mean over the physics steps."""
    force_peak: Float[Array, ""]
    """Greatest normal force on one geom pair [N]."""
    saturation: Float[Array, ""]
    """Share of the physics steps with a torque at its limit."""

    @staticmethod
    def none() -> SafetyRecord:
        """The record of no time at all."""
        no, zero = jnp.zeros((), bool), jnp.zeros(())
        return SafetyRecord(no, no, no, no, no, zero, zero, zero)

    @property
    def event(self) -> Bool[Array, ""]:
        """Whether anything happened that ends an episode."""
        return self.collision | self.self_collision | self.joint_limit

    def then(self, step: SafetyRecord, share: float) -> SafetyRecord:
        """This record extended by one physics step that is `share` of the whole."""
        return SafetyRecord(
            collision=self.collision | step.collision,
            arm_collision=self.arm_collision | step.arm_collision,
            self_collision=self.self_collision | step.self_collision,
            joint_limit=self.joint_limit | step.joint_limit,
            turn_limit=self.turn_limit | step.turn_limit,
            force=self.force + share * step.force,
            force_peak=jnp.maximum(self.force_peak, step.force_peak),
            saturation=self.saturation + share * step.saturation,
        )


def observe(
    scene: Scene, robot: Robot, state: PhysicsState, torque_scale: Float[Array, ""]
) -> SafetyRecord:
    """The record of the physics step that led to `state`."""
    contacts = read_contacts(scene.model, state)
    q = state.qpos[: robot.n]
    near_lower = q - robot.q_lower < LIMIT_MARGIN
    near_upper = robot.q_upper - q < LIMIT_MARGIN
    free = ~jnp.isfinite(robot.q_upper) & jnp.asarray(robot.hinge)
    return SafetyRecord(
        collision=jnp.any(contacts.touching & ~scene.own),
        arm_collision=jnp.any(contacts.touching & scene.arm),
        self_collision=jnp.any(contacts.touching & scene.own),
        joint_limit=jnp.any(near_lower | near_upper),
        turn_limit=jnp.any(free & (jnp.abs(q) > TURN - LIMIT_MARGIN)),
        force=jnp.sum(contacts.force),
        force_peak=jnp.max(contacts.force, initial=0.0),
        saturation=(torque_scale < 1.0).astype(q.dtype),
    )
