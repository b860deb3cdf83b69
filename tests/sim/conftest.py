"""A scene whose contact forces are known by heart, and the arm's scene."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from envs.scene import build_scene
from rmp_mjx.robot import Robot
from rmp_mjx.sim import add_pairs

# A ball of 2 kg and a lying rod of 3 kg that can only move up and down.
WEIGHTS = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 .1"/>
    <body name="ball" pos="0 0 .1">
      <joint name="ball" type="slide" axis="0 0 1"/>
      <geom name="ball" type="sphere" size=".1" mass="2"/>
    </body>
    <body name="rod" pos="1 0 .1">
      <joint name="rod" type="slide" axis="0 0 1"/>
      <geom name="rod" type="capsule" fromto="-.3 0 0 .3 0 0" size=".1" mass="3"/>
    </body>
    <body name="target" mocap="true" pos="0 0 5">
      <geom name="target" type="sphere" size=".1"/>
    </body>
  </worldbody>
  <actuator><motor joint="ball"/><motor joint="rod"/></actuator>
</mujoco>
"""
PAIRS = [("rod", "floor"), ("ball", "target"), ("ball", "floor")]


@pytest.fixture(scope="session")
def weights():
    spec = mujoco.MjSpec.from_string(WEIGHTS)
    add_pairs(spec, PAIRS)
    return spec.compile()


@pytest.fixture(scope="session")
def jaco():
    """The arm on its table with one sphere, and four scripted motions."""
    robot = Robot.load("jaco2")
    scene = build_scene(robot, sim_dt=0.005, spheres=1, sphere_radius=0.05)
    gravity = _bias(scene.model, robot.q_home)
    far, below = [0.0, 0.0, -5.0], [0.397, -0.018, -0.02]
    folded = _self_touching(scene, robot)
    hold = np.stack([gravity, 0 * gravity, 0 * gravity, _bias(scene.model, folded)])
    return SimpleNamespace(
        robot=robot,
        scene=scene,
        names=("waves", "onto the table", "onto a sphere", "onto itself"),
        q=np.stack([robot.q_home, robot.q_home, robot.q_home, folded]),
        mocap=np.array([far, far, below, far])[:, None],
        torque=lambda k: hold + _WAVES * np.sin(0.1 * k * np.arange(1, 8)),
    )


_WAVES = np.array([[1.0], [0.0], [0.0], [0.0]]) * [2, 2, 2, 2, 1, 0.5, 0.3]


def _bias(model, q):
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    return data.qfrc_bias.copy()


def _self_touching(scene, robot):
    """A random configuration in which two links touch, and nothing else does."""
    model, data = scene.model, mujoco.MjData(scene.model)
    rng = np.random.default_rng(0)
    low = np.where(np.isfinite(robot.q_lower), robot.q_lower, -np.pi)
    high = np.where(np.isfinite(robot.q_upper), robot.q_upper, np.pi)
    while True:
        data.qpos[:] = rng.uniform(low + 0.1, high - 0.1)
        mujoco.mj_forward(model, data)
        bodies = model.geom_bodyid[[c.geom for c in data.contact]]
        shallow = all(-0.02 < c.dist < -0.005 for c in data.contact)
        if data.ncon and shallow and np.all(bodies > 0):
            return data.qpos.copy()


class Reference:
    """A plain loop of MuJoCo's own `mj_step`, reading forces from its contacts."""

    def __init__(self, model, q, mocap=None, round_to=np.float64):
        self.model, self.data, self.round_to = model, mujoco.MjData(model), round_to
        self.data.qpos[:] = np.asarray(q, round_to)
        if mocap is not None:
            self.data.mocap_pos[:] = np.asarray(mocap, round_to)

    def step(self, ctrl):
        d, dtype = self.data, self.round_to
        d.ctrl[:] = np.asarray(ctrl, dtype)
        mujoco.mj_step(self.model, d)
        for field in (d.qpos, d.qvel, d.qacc_warmstart):
            field[:] = field.astype(dtype)

    def force(self, geom_a, geom_b):
        """Sum of a pair's normal forces, by `mj_contactForce`."""
        ids = {self.model.geom(geom_a).id, self.model.geom(geom_b).id}
        wrench, total = np.zeros(6), 0.0
        for k, contact in enumerate(self.data.contact):
            if set(contact.geom) == ids:
                mujoco.mj_contactForce(self.model, self.data, k, wrench)
                total += wrench[0]
        return total


@pytest.fixture(scope="session")
def reference():
    return Reference
