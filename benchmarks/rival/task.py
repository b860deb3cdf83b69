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
from numba import njit  # pyright: ignore[reportMissingImports]

from benchmarks.rival.controller import Arm, Fields

N = 7

FAST = {"contract", "reassoc", "nsz", "arcp"}
"""Floating-point freedoms that keep infinities (joints without limits) infinite."""


@njit(fastmath=FAST, cache=True)
def cross(a, b, out):
    """Vector product."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(fastmath=FAST, cache=True)
def dot(a, b):
    """Scalar product of 3-vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(fastmath=FAST, cache=True)
def barrier(leaf, x, xd):
    """Metric and acceleration of the one-dimensional barrier; see ours.

    The leaf is (mu, eps, eta, r, margin, x_min, cap, k_out, v_out).
    """
    mu, eps, eta, r, margin = leaf[0], leaf[1], leaf[2], leaf[3], leaf[4]
    gap = max(x - margin, leaf[5])
    if gap >= r:
        return 0.0, 0.0
    v = min(xd, 0.0)
    fade = (1.0 - gap / r) / (gap * gap)
    m = min(mu * fade * fade * (v * v + eps), leaf[6])
    if xd > 0.0:
        m *= np.exp(-xd / leaf[8])
    return m, -eta * v + v * v / gap + leaf[7] * max(margin - x, 0.0)


@njit(fastmath=FAST, cache=True)
def add_row(f, M, row, count, m, a):
    """Pull a scalar leaf with this Jacobian row back to the joints (lower triangle)."""
    for i in range(count):
        w = m * row[i]
        f[i] += w * a
        for j in range(i + 1):
            M[i, j] += w * row[j]


@njit(fastmath=FAST, cache=True)
def solve(A, b):
    """Solve A x = b in place for a symmetric positive A (lower triangle): L D L^T."""
    n = len(b)
    for j in range(n):
        for k in range(j):
            A[j, j] -= A[j, k] * A[j, k] * A[k, k]
        for i in range(j + 1, n):
            for k in range(j):
                A[i, j] -= A[i, k] * A[j, k] * A[k, k]
            A[i, j] /= A[j, j]
    for i in range(n):
        for k in range(i):
            b[i] -= A[i, k] * b[k]
    for i in range(n):
        b[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= A[k, i] * b[k]


@njit(fastmath=FAST, cache=True)
def unpack(packed, Mq):
    """Both triangles of the inertia from MuJoCo's rows (a chain's have no gaps)."""
    at = 0
    for i in range(N):
        for j in range(i + 1):
            Mq[i, j] = Mq[j, i] = packed[at]
            at += 1


@njit(fastmath=FAST, cache=True)
def twists(anchor, axis, qd, S, V, A):
    """Joint columns, link twists and their rates at qdd = 0, (n, 6) each."""
    for j in range(N):
        z, s = axis[j], S[j]
        cross(anchor[j], z, s[:3])
        s[3:] = z
        for k in range(6):
            V[j, k] = s[k] * qd[j] + (V[j - 1, k] if j else 0.0)
        v, w = V[j, :3], V[j, 3:]
        for k in range(3):
            a, b = (k + 1) % 3, (k + 2) % 3
            lin = w[a] * s[b] - w[b] * s[a] + v[a] * z[b] - v[b] * z[a]
            ang = w[a] * z[b] - w[b] * z[a]
            A[j, k] = lin * qd[j] + (A[j - 1, k] if j else 0.0)
            A[j, 3 + k] = ang * qd[j] + (A[j - 1, 3 + k] if j else 0.0)


@njit(fastmath=FAST, cache=True)
def move(V, A, j, x, v, a):
    """Velocity and acceleration (qdd = 0) of the point x on link j; -1: at rest."""
    if j < 0:
        v[:] = 0.0
        a[:] = 0.0
        return
    for k in range(3):
        p, q = (k + 1) % 3, (k + 2) % 3
        v[k] = V[j, k] + V[j, 3 + p] * x[q] - V[j, 3 + q] * x[p]
        a[k] = A[j, k] + A[j, 3 + p] * x[q] - A[j, 3 + q] * x[p]
    for k in range(3):
        p, q = (k + 1) % 3, (k + 2) % 3
        a[k] += V[j, 3 + p] * v[q] - V[j, 3 + q] * v[p]


@njit(fastmath=FAST, cache=True)
def row_of(S, n, x, first, last, row):
    """Jacobian row n . J of the point x, joints first to last; the others zero."""
    xn = np.empty(3)
    cross(x, n, xn)
    for j in range(last + 1):
        row[j] = 0.0
        if j >= first:
            row[j] = dot(n, S[j, :3]) + dot(xn, S[j, 3:])


@njit(fastmath=FAST, cache=True)
def clamp(x):
    """To [0, 1]."""
    return min(max(x, 0.0), 1.0)


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
