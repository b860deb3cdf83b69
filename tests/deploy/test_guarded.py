"""A guard in the loop: a sphere chases the arm, and what it hits stands still."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

import envs
from envs import export
from rmp_mjx import deploy
from rmp_mjx.deploy.backends import Pace
from rmp_mjx.sim.robot import MujocoBackend

POLICY = "pretrained/trajectory-rmp_vices"
RADIUS, SPEED = 0.05, 0.2
"""Of the sphere [m, m/s]."""


class Chased:
    """A simulated arm, and a sphere that goes for its hand until they meet."""

    pace: Pace = "simulation"
    carries_weight = False

    def __init__(self, robot, deployed, source):
        spec = robot.mj_spec
        spec.option.timestep = 0.001
        ball = spec.worldbody.add_body(name="ball", mocap=True)
        geom = ball.add_geom(name="ball", size=[RADIUS, 0.0, 0.0])
        geom.type, geom.contype, geom.conaffinity = mujoco.mjtGeom.mjGEOM_SPHERE, 1, 1
        self.model = spec.compile()
        arm = np.arange(self.model.ngeom) != self.model.geom("ball").id
        self.model.geom_contype[arm], self.model.geom_conaffinity[arm] = 2, 1
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = deployed.start
        self.hand, self.source = robot.site_name, source
        self.arm = MujocoBackend(self.model, self.data, deployed.n)
        mujoco.mj_forward(self.model, self.data)
        away = np.array([0.0, 0.25, 0.1])
        self.data.mocap_pos[0] = self.data.site(self.hand).xpos + away
        self.speed: float | None = None

    def read(self):
        way = self.data.site(self.hand).xpos - self.data.mocap_pos[0]
        velocity = SPEED * way / np.linalg.norm(way)
        if self.speed is None:
            self.data.mocap_pos[0] += velocity * self.model.opt.timestep
        self.source.put(
            "spheres",
            center=self.data.mocap_pos.copy(),
            radius=[RADIUS],
            velocity=[velocity],
        )
        return self.arm.read()

    def write(self, tau):
        before = self.data.qvel.copy()
        self.arm.write(tau)
        if self.speed is None and self.data.ncon:
            self.speed = max(self._speed(c, before) for c in self.data.contact)

    finish = write

    def _speed(self, contact, qd):
        """Speed of the arm where it is touched [m/s]."""
        jacobian = np.zeros((3, self.model.nv))
        bodies = self.model.geom_bodyid[list(contact.geom)]
        (body,) = (b for b in bodies if b != self.model.body("ball").id)
        mujoco.mj_jac(self.model, self.data, jacobian, None, contact.pos, int(body))
        return float(np.linalg.norm(jacobian @ qd))


@pytest.fixture(scope="module")
def robot():
    return envs.load("trajectory", physics="mujoco").robot


def _chased(root, tmp_path, robot, *flags):
    file = tmp_path / f"arm{len(flags)}.rmp"
    run = str(root / POLICY)
    assert export.main([run, "--out", str(file), *flags]) == 0
    deployed = deploy.load(file)
    source = deploy.ObstacleSource(deployed.obstacles(), clock=lambda: 0.0)
    chased = Chased(robot, deployed, source)
    points = [[0.35, -0.1, 0.1], [0.5, 0.1, 0.2], [0.35, 0.15, 0.1], [0.45, -0.1, 0.2]]
    targets = deploy.PolicyTargets(deployed, deploy.ViaPoints(np.array(points)))
    never = deploy.Watchdog(stale=None)
    loop = deploy.Loop(deployed, chased, targets, source, never)
    loop.run(4.0, until=lambda: chased.speed is not None)
    return SimpleNamespace(speed=chased.speed, card=deployed.card)


def test_a_guarded_arm_in_the_loop_stands_still_where_a_sphere_hits_it(
    root, tmp_path, robot
):
    """5 cm/s is the guard's bound; without it the arm is hit while it moves."""
    guarded = _chased(root, tmp_path, robot, "--guard_speed", str(SPEED))
    assert guarded.speed is not None and guarded.speed < 0.05
    assert "no faster than 0.2 m/s, finds it slower than 0.05 m/s" in guarded.card
    free = _chased(root, tmp_path, robot)
    assert free.speed is not None and free.speed > 0.05
