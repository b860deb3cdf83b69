"""Domain randomisation: what an episode draws anew of the arm and of its task.

The physics get what is drawn; the controller and the policy keep the nominal values.
Everything is off by default, and then nothing is drawn at all.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int

from rmp_mjx.pytree import Pytree

from .scene import ARM

Range = tuple[float, float]
"""Least and greatest value; each draw is uniform between them."""

_SAME: Range = (1.0, 1.0)
_NONE: Range = (0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class Randomisation:
    """Ranges, one draw an episode; factors are on the nominal value."""

    link_mass: Range = _SAME
    """Factor on mass and inertia of each link of the arm."""
    rotor_inertia: Range = _SAME
    """Factor on the rotor inertia of each joint."""
    joint_damping: Range = _NONE
    """Viscous friction that each joint has besides its own [N m s/rad]."""
    torque_constant: Range = _SAME
    """Torque of each motor over its command."""
    control_delay: Range = _NONE
    """Delay of the torques [s], rounded to physics steps."""
    object_mass: Range = _SAME
    """Factor on mass and inertia of door or block."""
    object_friction: Range = _SAME
    """Factor on the sliding friction of the work: hand on handle or block, block on
    table."""
    object_damping: Range = _SAME
    """Factor on the damping of the door's hinge."""
    position_noise: float = 0.0
    """Standard deviation of the joint positions that the controller gets, drawn anew
    at every control step [rad]."""
    velocity_noise: float = 0.0
    """Standard deviation of the joint velocities that controller and observer get,
    drawn anew at every control step [rad/s]."""

    def __post_init__(self):
        """Check the values.

        Raises:
            ValueError: A range is none.
        """
        for name, usual in RANGES.items():
            value = getattr(self, name)
            if len(value) != 2 or not 0.0 <= value[0] <= value[1]:
                raise ValueError(
                    f"{name} must be two numbers of at least 0, the least first, is "
                    f"{value}"
                )
            if usual == _SAME and not value[0] > 0.0:
                raise ValueError(f"{name} is a factor and must be positive, is {value}")


RANGES: dict[str, Range] = {
    field.name: field.default
    for field in dataclasses.fields(Randomisation)
    if isinstance(field.default, tuple)
}
"""The ranges that draw nothing, by name."""


class Motors(Pytree):
    """What becomes of the torques that the controller commands in an episode."""

    constant: Float[Array, " n"]
    """Torque of each motor over its command."""
    delay: Int[Array, ""]
    """Control steps until a command acts."""
    commands: Float[Array, "k n"]
    """The last commands, newest first, one more than the greatest delay [N m]."""

    def then(self, tau: Float[Array, " n"]) -> Motors:
        """After a control step with this command, (n,) [N m]."""
        return self.replace(commands=jnp.concatenate([tau[None], self.commands[:-1]]))

    @property
    def torque(self) -> Float[Array, " n"]:
        """The torque that acts now [N m]."""
        return self.constant * jnp.take(self.commands, self.delay, axis=0)


def draw_motors(
    rng: Array, ranges: Randomisation, hold: Float[Array, " n"], dt: float
) -> Motors | None:
    """An episode's motors; None if they do as they are told.

    Args:
        rng: Key.
        ranges: The ranges.
        hold: Torque that held the arm before the episode, (n,) [N m].
        dt: Control step [s].
    """
    if (ranges.torque_constant, ranges.control_delay) == (_SAME, _NONE):
        return None
    key_constant, key_delay = jax.random.split(rng)
    low, high = (round(end / dt) for end in ranges.control_delay)
    return Motors(
        constant=_uniform(key_constant, ranges.torque_constant, hold.shape),
        delay=jax.random.randint(key_delay, (), low, high + 1),
        commands=jnp.broadcast_to(hold, (high + 1, *hold.shape)),
    )


def draw_model(
    rng: Array, ranges: Randomisation, model: mujoco.MjModel
) -> dict[str, Array]:
    """Fields of the model that an episode has instead of the nominal ones.

    Only fields whose range is not the nominal value are there. A link's mass and its
    inertia are scaled alike, so each remains a body's.

    Args:
        rng: Key.
        ranges: The ranges.
        model: The scene; the arm's names begin with `arm/`.
    """
    keys = dict(zip(RANGES, jax.random.split(rng, len(RANGES)), strict=True))
    arm = np.array([model.body(i).name.startswith(ARM) for i in range(model.nbody)])
    of_arm = arm[model.dof_bodyid]
    found: dict[str, Array] = {}

    def factors(name: str, where: np.ndarray) -> Array:
        drawn = _uniform(keys[name], getattr(ranges, name), where.shape)
        return jnp.where(where, drawn, 1.0)

    def varies(*names: str) -> bool:
        return any(getattr(ranges, name) != RANGES[name] for name in names)

    if varies("link_mass", "object_mass"):
        scale = factors("link_mass", arm) * factors("object_mass", ~arm)
        found["body_mass"] = scale * model.body_mass
        found["body_inertia"] = scale[:, None] * model.body_inertia
    if varies("rotor_inertia"):
        found["dof_armature"] = factors("rotor_inertia", of_arm) * model.dof_armature
    if varies("joint_damping", "object_damping"):
        more = _uniform(keys["joint_damping"], ranges.joint_damping, of_arm.shape)
        own = factors("object_damping", ~of_arm) * model.dof_damping
        found["dof_damping"] = own + jnp.where(of_arm, more, 0.0)
    if varies("object_friction"):
        # Contact without friction is one-dimensional, and stays so.
        rough = np.asarray(model.pair_dim) > 1
        scale = jnp.where(rough, factors("object_friction", np.ones(1, bool)), 1.0)
        sliding = scale[:, None] * model.pair_friction[:, :2]
        found["pair_friction"] = jnp.concatenate(
            [sliding, jnp.asarray(model.pair_friction[:, 2:], sliding.dtype)], axis=1
        )
    return found


def _uniform(rng: Array, ends: Range, shape: tuple[int, ...]) -> Array:
    return jax.random.uniform(rng, shape, minval=ends[0], maxval=ends[1])
