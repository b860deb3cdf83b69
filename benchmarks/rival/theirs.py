"""The rival as a contestant, in its own virtual environment."""

from __future__ import annotations

import os
import sys
from functools import partial
from pathlib import Path

import mujoco
import mujoco.batch
import numpy as np
import torch  # pyright: ignore[reportMissingImports]

from benchmarks.peers.worker import Measure, rate, serve
from benchmarks.rival import controller
from benchmarks.rival.ppo import UNROLL, train
from benchmarks.rival.task import Trajectory

CONTROLLERS = {"rmp_vices": controller.rmp_vices, "vices": controller.vices}


class Rival:
    """The measures of the rival.

    Args:
        scene: The compiled scene.
        arrays: The problem.
        num_envs: Environments of a training.
    """

    def __init__(self, scene: Path, arrays: Path, num_envs: int):
        """Read the problem."""
        self.model = mujoco.MjModel.from_binary_path(str(scene))
        self.arrays = dict(np.load(arrays))
        constants = {
            name: self.arrays[f"arm_{name}"] for name in controller.Arm._fields
        }
        constants |= {"site": int(constants["site"])}
        constants |= {"table": float(constants["table"])}
        self.arm, self.num_envs = controller.Arm(**constants), num_envs

    def torques(self, name: str):
        """A call of the controller on the problem's states, and its result."""
        given = self.arrays
        size = len(given["q"])
        batch = mujoco.batch.Batch(self.model, size, persistent=True)
        fields = controller.Fields(
            *(batch.bind(field) for field in controller.Fields._fields)
        )
        fields.qpos[:], fields.qvel[:] = given["q"], given["qd"]
        batch.forward()
        spheres = np.broadcast_to(given["spheres"], (size, *given["spheres"].shape))
        tau = np.zeros_like(given["q"])
        args = (given["p_des"], given["R_des"], given["kp"], spheres.copy(), tau)
        return partial(CONTROLLERS[name], self.arm, fields, *args), tau

    def disagreement(self, name: str) -> Measure:
        """Largest difference of a torque to ours, over the joint's limit."""
        call, tau = self.torques(name)
        call()
        error = np.abs(tau - self.arrays[f"tau_{name}"]) / self.arm.tau_max
        return lambda seconds: float(error.max())

    def evals(self, name: str) -> Measure:
        """Evaluations a second of the whole batch."""
        call, tau = self.torques(name)
        return rate(call, len(tau))

    def env_steps(self, name: str) -> Measure:
        """Policy steps a second under random actions."""
        env = Trajectory(self.model, self.arm, CONTROLLERS[name], self.num_envs)
        rng = np.random.default_rng(1)
        return rate(lambda: env.step(rng.uniform(-1.0, 1.0, (env.size, 12))), env.size)

    def training(self, name: str) -> Measure:
        """Policy steps a second of training, updates included."""
        env = Trajectory(self.model, self.arm, CONTROLLERS[name], self.num_envs)
        iterations = train(env)
        return rate(lambda: next(iterations), env.size * UNROLL)


if __name__ == "__main__":
    # Before the first parallel loop: its threads must not spin while MuJoCo's work.
    os.environ["OMP_WAIT_POLICY"] = "passive"
    torch.set_num_threads(1)  # faster than two for networks and batches of this size
    rival = Rival(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
    serve(
        {
            f"{what}_{name}": partial(getattr(rival, what), name)
            for what in ("disagreement", "evals", "env_steps", "training")
            for name in CONTROLLERS
        },
        ("numba", "torch", "mujoco", "numpy"),
    )
