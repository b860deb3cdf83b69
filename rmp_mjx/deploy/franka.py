"""A Franka Research 3 through Franka's own Python bindings, pylibfranka.

The robot adds what carries its own weight and that of the load that Desk or `set_load`
knows, so gravity is not sent. Its control box keeps time: `read` waits for its next
state. It stops itself, with its brakes, where a command breaks its limits or comes too
late 20 times (a *reflex*); `recover` clears that.
"""

from __future__ import annotations

import importlib
import time
from typing import Any, Literal

import numpy as np

from rmp_mjx.deploy.deployed import Deployed

JOINTS = 7
"""Joints of the arm."""
AXIS_ERROR = 0.01
"""The file's grip may be so far from the robot's tool axis [m]."""
TORQUE, FORCE = 40.0, 60.0
"""Thresholds of the robot's own collision reflex [N m; N, N m], above what the
controller's contacts cause and below what hurts the arm."""
AT_ONCE = 5e-5
"""A state that is there within this time has waited for us [s]."""


class WrongRobotError(ValueError):
    """The file is for another robot than the one that is connected."""


class FrankaBackend:
    """An FR3 under torque control."""

    pace: Literal["robot"] = "robot"
    """The robot keeps time."""
    carries_weight = True
    """Gravity is the robot's own affair."""

    def __init__(
        self,
        deployed: Deployed,
        address: str,
        realtime: bool = True,
        ahead: bool = False,
    ):
        """Connect, and see that it is the robot of the file. Nothing moves.

        Args:
            deployed: The file.
            address: Of the robot, for instance 172.16.0.2.
            realtime: Whether to insist on a real-time kernel; without one, the robot
                stops now and then.
            ahead: Whether a torque answers the state after the one that it is for. It
                is then there at once, a millisecond late for the controller: for a
                machine that needs most of a millisecond for it.

        Raises:
            ImportError: pylibfranka is not installed.
            WrongRobotError: The file is for another arm.
        """
        _check_file(deployed)
        try:
            self._franka: Any = importlib.import_module("pylibfranka")
        except ImportError as error:
            raise ImportError(
                f"this needs pylibfranka, pip install 'rmp-mjx[franka]': {error}"
            ) from error
        config = self._franka.RealtimeConfig
        self.robot: Any = self._franka.Robot(
            address, config.kEnforce if realtime else config.kIgnore
        )
        self._control: Any = None
        self._ahead, self._waiting = ahead, None
        _check_pose(deployed, self.robot.read_once())

    def recover(self) -> None:
        """Clear a reflex, after a person has seen why it came."""
        self._control = None
        self.robot.automatic_error_recovery()

    def look(self) -> tuple[np.ndarray, np.ndarray]:
        """The state while nobody controls the robot."""
        state = self.robot.read_once()
        return np.array(state.q), np.array(state.dq)

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """The robot's next state; the first call starts torque control.

        A state that has waited while the loop was late is let go: the answer to it
        would be late again, and so would all that follow.

        Raises:
            pylibfranka.FrankaException: The robot has stopped itself.
        """
        if self._control is None:
            self.robot.set_collision_behavior(
                [TORQUE] * JOINTS, [TORQUE] * JOINTS, [FORCE] * 6, [FORCE] * 6
            )
            self._waiting = None
            self._control = self.robot.start_torque_control()
        try:
            called = time.perf_counter()
            state, _ = self._control.readOnce()
            if time.perf_counter() - called < AT_ONCE:
                state, _ = self._control.readOnce()
            if self._waiting is not None:
                self._control.writeOnce(self._waiting)
        except Exception:
            self._control = None
            raise
        return np.array(state.q), np.array(state.dq)

    def write(self, tau: np.ndarray) -> None:
        """Send torques without gravity, (7,) [N m]."""
        torques = self._franka.Torques(tau.tolist())
        if self._ahead:
            self._waiting = torques
            return
        try:
            self._control.writeOnce(torques)
        except Exception:
            self._control = None
            raise

    def finish(self, tau: np.ndarray) -> None:
        """Send the last torques, and give the arm back to the robot."""
        last = self._franka.Torques(tau.tolist())
        last.motion_finished = True
        self._control.writeOnce(last)
        self._control = None


def _check_file(deployed: Deployed) -> None:
    """Refuse files of other arms.

    Raises:
        WrongRobotError: The file is for another arm.
    """
    robot = deployed.metadata["robot"]
    if len(robot["joints"]) != JOINTS:
        raise WrongRobotError(
            f"the file is for '{robot['name']}', {len(robot['joints'])} joints; an FR3 "
            f"has {JOINTS}: export with --robot fr3"
        )
    if robot["name"] == "panda":
        raise WrongRobotError(
            "the file is for 'panda'; these bindings reach the FR3 alone: export with "
            "--robot fr3"
        )


def _check_pose(deployed: Deployed, state: Any) -> None:
    """See that robot and file agree where the tool's axis is.

    Raises:
        WrongRobotError: They do not.
    """
    q = np.array(state.q)[None]
    T = np.array(state.O_T_EE).reshape(4, 4).T
    grip = np.asarray(deployed.grip(q, np.zeros_like(q))["p"])[0]
    away = grip - np.array(deployed.metadata["robot"]["mount"]) - T[:3, 3]
    error = np.linalg.norm(away - (away @ T[:3, 2]) * T[:3, 2])
    if error > AXIS_ERROR:
        raise WrongRobotError(
            f"the grip of '{deployed.robot}' should be on the tool's axis and is "
            f"{100 * error:.1f} cm from it: is it the file of this arm?"
        )
