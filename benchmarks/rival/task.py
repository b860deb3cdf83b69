"""The trajectory task in NumPy on MuJoCo's batch of C simulations.

Scene, start, via points, observation, reward and terminations are ours. It leaves out
the rest of our safety record (forces, clearance, smoothness of the torques).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import mujoco.batch
import numpy as np

from benchmarks.rival.controller import Arm, Fields
from benchmarks.rival.kernels import N

LOW, HIGH = np.array([0.30, -0.20, 0.03]), np.array([0.55, 0.20, 0.28])
POINTS = 4
LENGTH = 1024
SUBSTEPS = 10
OBSERVATION_SIZE = 18 + 4 * POINTS
ACTION_SIZE = 12

Controller = Callable[..., None]


@dataclass
class Steps:
    """Result of a policy step, one row per environment."""

    obs: np.ndarray
    """Observation; of the new episode where one ended."""
    next_obs: np.ndarray
    """Observation before that."""
    reward: np.ndarray
    """Reward."""
    terminated: np.ndarray
    """Whether the task or an event ended the episode."""
    truncated: np.ndarray
    """Whether the time limit did."""
    success: np.ndarray
    """Whether all via points are reached."""


class Trajectory:
    """A batch of environments with automatic resets."""

    def __init__(
        self, model: mujoco.MjModel, arm: Arm, controller: Controller, size: int
    ):
        """Start all environments, at random ages."""
        self.arm, self.controller, self.size = arm, controller, size
        self.rng = np.random.default_rng(0)
        self.batch = mujoco.batch.Batch(model, size, persistent=True)
        self.fields = Fields(*(self.batch.bind(name) for name in Fields._fields))
        self.ctrl, self.sensors = (self.batch.bind(n) for n in ("ctrl", "sensordata"))
        self.points = np.zeros((size, POINTS, 3))
        self.reached = np.zeros(size, int)
        self.spheres = np.zeros((size, 0, 4))
        self.tau = np.zeros((size, N))
        self.age = self.rng.integers(0, LENGTH, size)
        self.start(np.arange(size))

    def start(self, ids: np.ndarray) -> None:
        """New episodes."""
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        noise = 0.02 * self.rng.standard_normal((len(ids), N))
        self.fields.qpos[ids] = self.arm.q_home + noise
        self.batch.forward(ids)
        self.reached[ids] = 0
        todo = ids
        while len(todo):  # via points at least 10 cm apart
            drawn = self.rng.uniform(LOW, HIGH, (len(todo), POINTS, 3))
            gaps = np.linalg.norm(drawn[:, :, None] - drawn[:, None], axis=3)
            gaps += np.eye(POINTS)
            self.points[todo] = drawn
            todo = todo[gaps.min(axis=(1, 2)) < 0.1]

    def observe(self) -> np.ndarray:
        """Observations, (b, n) float32."""
        site, fields = self.arm.site, self.fields
        p, R = fields.site_xpos[:, site], fields.site_xmat[:, site]
        z, lever = fields.xaxis, p[:, None] - fields.xanchor
        v = np.einsum("bjk,bj->bk", np.cross(z, lever), fields.qvel)
        w = np.einsum("bjk,bj->bk", z, fields.qvel)
        turn = (np.arange(POINTS) + self.reached[:, None]) % POINTS
        rows = np.arange(self.size)[:, None]
        to_points = self.points[rows, turn] - p[:, None]
        checked = (np.arange(POINTS) < self.reached[:, None])[rows, turn]
        parts = (p, R, v, w, to_points.reshape(self.size, -1), checked)
        return np.concatenate(parts, axis=1, dtype=np.float32)

    def setpoint(self, action: np.ndarray):
        """Targets and stiffness of actions in [-1, 1]^12."""
        site, action = self.arm.site, np.clip(action, -1.0, 1.0).astype(float)
        p_des = self.fields.site_xpos[:, site] + 0.05 * action[:, :3]
        turn = 0.2 * action[:, 3:6]
        angle = np.linalg.norm(turn, axis=1)[:, None, None]
        x, y, z = (turn / np.maximum(angle[:, 0], 1e-9)).T
        zero = np.zeros_like(x)
        K = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
        turned = np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * (K @ K)
        R_des = turned @ self.fields.site_xmat[:, site].reshape(-1, 3, 3)
        return p_des, R_des, 10.0 * 30.0 ** (0.5 * (action[:, 6:] + 1.0))

    def step(self, action: np.ndarray) -> Steps:
        """One policy step of every environment; finished ones are reset."""
        setpoint = self.setpoint(action)
        event = np.zeros(self.size, bool)
        for _ in range(SUBSTEPS):
            self.controller(self.arm, self.fields, *setpoint, self.spheres, self.tau)
            self.ctrl[:] = self.tau
            self.batch.step(stage=mujoco.mjtStage.mjSTAGE_VEL)
            contact = self.sensors.reshape(self.size, -1, 5)
            event |= ((contact[..., 0] > 0) & (contact[..., 4] < 0)).any(axis=1)
            q = self.fields.qpos
            event |= (q - self.arm.q_lower < 0.1).any(axis=1)
            event |= (self.arm.q_upper - q < 0.1).any(axis=1)
        self.age += 1
        site = self.fields.site_xpos[:, self.arm.site]
        current = self.points[
            np.arange(self.size), np.minimum(self.reached, POINTS - 1)
        ]
        distance = np.linalg.norm(current - site, axis=1)
        hit = distance < 0.05
        self.reached += hit
        success = self.reached == POINTS
        reward = np.where(hit, 100.0, 30.0 * (1.0 - np.tanh(5.0 * distance)))
        reward += np.where(success, 25.0 * (LENGTH - self.age), 0.0) - 50.0 * event
        next_obs = obs = self.observe()
        terminated = success | event
        truncated = ~terminated & (self.age >= LENGTH)
        ended = np.flatnonzero(terminated | truncated)
        if ended.size:
            self.start(ended)
            self.age[ended] = 0
            obs = self.observe()
        return Steps(obs, next_obs, reward, terminated, truncated, success)
