"""A simulated arm in the place of a robot, for `rmp_mjx.deploy.Loop`."""

from __future__ import annotations

from typing import Literal

import mujoco
import numpy as np


class MujocoBackend:
    """MuJoCo C behind the loop: a tick is a step or more, as fast as they go."""

    pace: Literal["simulation"] = "simulation"
    """A tick takes exactly a period."""
    carries_weight = False
    """The motors carry the arm."""

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, n: int, period: float = 0.001
    ):
        """Keep the simulation.

        Args:
            model: Its first n joints are the arm's, its first n controls their torques.
            data: Its state.
            n: Number of joints.
            period: Time of a tick, a multiple of the model's timestep [s].

        Raises:
            ValueError: It is none.
        """
        steps = round(period / model.opt.timestep)
        if steps < 1 or abs(steps * model.opt.timestep - period) > 1e-9:
            raise ValueError(
                f"a tick of {period} s is no multiple of {model.opt.timestep} s"
            )
        self.model, self.data, self.n, self._steps = model, data, n, steps

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Joint positions (n,) [rad] and velocities (n,) [rad/s]."""
        return self.data.qpos[: self.n].copy(), self.data.qvel[: self.n].copy()

    def write(self, tau: np.ndarray) -> None:
        """Apply torques (n,) [N m] for one tick."""
        self.data.ctrl[: self.n] = tau
        mujoco.mj_step(self.model, self.data, self._steps)

    finish = write
