"""Tasks compiled once, and the same physics in MuJoCo C to check them against."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from flax import struct

import envs
from rmp_mjx.robot import Robot
from rmp_mjx.types import ControlOutput, Setpoint

LANES = 8


@struct.dataclass
class Torques:
    """A controller that compiles fast: the action is a torque on top of `hold`."""

    hold: jax.Array

    def decode(self, action):
        return action

    def setpoint(self, q, action):
        return Setpoint(jnp.zeros(3), jnp.eye(3), action[:3], action[3:6])

    def __call__(self, q, qd, setpoint, obstacles):
        push = jnp.concatenate([setpoint.kp_pos, setpoint.kp_ori, jnp.zeros(1)])
        tau = self.hold + push
        return ControlOutput(
            tau=tau,
            qdd=tau,
            f=tau,
            M=jnp.eye(7),
            diagnostics={"torque_scale": jnp.where(push[5] > 0.0, 0.5, 1.0)},
        )


@pytest.fixture(scope="session")
def make():
    """`make(controller, **options)`: the env, its vmapped reset and step, compiled."""

    @functools.cache
    def build(controller, **options):
        if controller == "torques":
            robot = Robot.load("jaco2")
            data = mujoco.MjData(robot.mj_model)
            data.qpos[:] = robot.q_home
            mujoco.mj_forward(robot.mj_model, data)
            controller = Torques(np.asarray(data.qfrc_bias, np.float32))
        options = {"physics": "mujoco", "obstacles": 2} | options
        env = envs.load("trajectory", controller=controller, **options)
        return SimpleNamespace(
            env=env,
            reset=jax.jit(jax.vmap(env.reset)),
            step=jax.jit(jax.vmap(env.step)),
        )

    return build


@pytest.fixture(scope="session")
def far(make):
    """Default options, two spheres; 1,000 starts."""
    task = make("torques")
    task.starts = task.reset(jax.random.split(jax.random.key(0), 1000))
    return task


@pytest.fixture(scope="session")
def close(make):
    """Every option that is not the default; 1,000 starts."""
    task = make(
        "torques",
        layout="close",
        observation="fixed",
        event_penalty=7.0,
        terminate_on_event=False,
        terminate_on_success=False,
    )
    task.starts = task.reset(jax.random.split(jax.random.key(1), 1000))
    return task


@pytest.fixture(scope="session")
def quiet(far):
    """Eight starts at the home pose, spheres and via points out of the way."""
    state = first(far.starts)
    q = jnp.tile(far.env.robot.q_home.astype(np.float32), (LANES, 1))
    away = jnp.broadcast_to(jnp.array([0.0, 0.0, -5.0]), state.data.mocap_pos.shape)
    data = state.data.replace(qpos=q, qvel=0 * q, mocap_pos=away)
    points = jnp.array(
        [[0.3, 0.2, 0.2], [0.5, 0.2, 0.2], [0.5, -0.2, 0.2], [0.3, 0, 0.3]]
    )
    info = state.info | {"points": jnp.tile(points, (LANES, 1, 1))}
    return state.replace(data=data, info=info)


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


@pytest.fixture(scope="session")
def arm(far):
    return Arm(far.env.scene.model)
