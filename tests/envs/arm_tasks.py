"""What the tests of the tasks share: a toy controller, and MuJoCo C as the judge."""

import dataclasses
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs import registry
from envs.options import Options
from rmp_mjx.pytree import Pytree
from rmp_mjx.robot import Robot
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state
from rmp_mjx.types import ControlOutput, Setpoint
from tests.training import toys

LANES = 8


class Torques(Pytree):
    """A controller that compiles fast: the action is a torque on top of `hold`."""

    hold: jax.Array | np.ndarray
    lean: float = 0.0
    """Share of the contacts' torque that it adds."""
    robot: Robot | None = None
    """The arm whose dynamics it reports; None: those of none."""

    def decode(self, action):
        return action

    def setpoint(self, q, action, time):
        return Setpoint(jnp.zeros(3), jnp.eye(3), action[:3], action[3:6], time)

    def __call__(self, q, qd, setpoint, obstacles, tau_ext=None, tau_last=None):
        push = jnp.concatenate([setpoint.kp_pos, setpoint.kp_ori, jnp.zeros(1)])
        tau = jnp.asarray(self.hold) + push
        Mq, bias = jnp.eye(7), jnp.zeros(7)
        if self.robot is not None:
            Mq, bias = dynamics(self.robot, arm_state(self.robot, q, qd))
        if tau_ext is not None:
            tau = tau + self.lean * tau_ext
        return ControlOutput(
            tau=tau,
            qdd=tau,
            f=tau,
            M=jnp.eye(7),
            Mq=Mq,
            bias=bias,
            diagnostics={"torque_limit": jnp.where(push[5] > 0.0, jnp.eye(7)[0], 0.0)},
        )


def first(state, count=LANES):
    return jax.tree.map(lambda x: x[:count], state)


class Arm:
    """Poses, velocities and contact forces of a scene, by MuJoCo C alone."""

    def __init__(self, model):
        self.model, self.data = model, mujoco.MjData(model)

    def site(self, q, qd=None):
        """Position, rotation, velocity and angular velocity of the grip."""
        d = self.data
        d.qpos[:] = q
        d.qvel[:] = 0.0 if qd is None else qd
        mujoco.mj_kinematics(self.model, d)
        mujoco.mj_comPos(self.model, d)
        site, jp, jr = (
            self.model.site("arm/grip").id,
            np.zeros((3, 7)),
            np.zeros((3, 7)),
        )
        mujoco.mj_jacSite(self.model, d, jp, jr, site)
        return (
            d.site_xpos[site].copy(),
            d.site_xmat[site].reshape(3, 3).copy(),
            jp @ d.qvel,
            jr @ d.qvel,
        )

    def roll(self, data, tau, steps):
        """Constant torque for some physics steps: (q, touched, sum, peak) of each."""
        d, rows = mujoco.MjData(self.model), []
        d.qpos[:], d.qvel[:] = data.qpos, data.qvel
        d.qacc_warmstart[:], d.mocap_pos[:] = data.warmstart, data.mocap_pos
        d.ctrl[:] = tau
        for _ in range(steps):
            mujoco.mj_step(self.model, d)
            force, wrench = {}, np.zeros(6)
            for k, contact in enumerate(d.contact):
                mujoco.mj_contactForce(self.model, d, k, wrench)
                pair = frozenset(self.model.geom(g).name for g in contact.geom)
                force[pair] = force.get(pair, 0.0) + wrench[0]
            rows.append((d.qpos.copy(), force))
        return rows


@dataclasses.dataclass(frozen=True)
class CounterOptions(Options):
    """Options of counting."""

    env: ClassVar[str] = "counter"
    variant: Literal["light", "heavy"] = "light"
    """Which counter."""


class Counter:
    """Makes the toy in place of an arm; the engine's name is what was asked for."""

    Options = CounterOptions

    def __new__(cls, options, robot=None, controller=None):
        return toys.Counter(engine=options.physics)


def register(monkeypatch):
    """Make the toy known; returns the options that tasks are made with from then on."""
    made, make = [], registry.make

    def noted(options, *rest):
        made.append(options)
        return make(options, *rest)

    monkeypatch.setitem(registry.ENVS, "counter", Counter)
    monkeypatch.setattr(registry, "make", noted)
    return made
