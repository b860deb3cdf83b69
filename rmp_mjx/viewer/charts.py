"""Strip charts of the last seconds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
from viser import uplot

from rmp_mjx.robot import Robot
from rmp_mjx.viewer.session import PERIOD, Frame

SPAN = 8.0
"""Seconds that the charts show."""
_EVERY = 8
"""Steps from one point of a chart to the next."""
_LINES = (
    "#1a6ebe",
    "#d73027",
    "#1a9850",
    "#7a46aa",
    "#f48c3c",
    "#777777",
    "#00a5a5",
    "#b5651d",
)


class Charts:
    """One chart for each quantity: a line for each arm, or for each joint."""

    def __init__(self, gui: viser.GuiApi, robot: Robot):
        """Make no chart before there is something to show."""
        self._robot, self._gui = robot, gui
        self.charts: dict[str, viser.GuiUplotHandle] = {}

    def show(self, frames: Sequence[Frame]) -> None:
        """Draw the end of a history."""
        if len(frames) < 2 * _EVERY:
            return
        names = frames[-1].controllers
        shown = [*frames[::-_EVERY]][: round(SPAN / PERIOD / _EVERY)][::-1]
        shown = [frame for frame in shown if frame.controllers == names]
        time = np.array([frame.time for frame in shown])
        for title, lines in quantities(self._robot, shown).items():
            series = (uplot.Series(label="t [s]"), *map(_series, lines, _LINES))
            data = (time, *lines.values())
            if title not in self.charts:
                self.charts[title] = self._gui.add_uplot(
                    data,
                    series,
                    title=title,
                    scales={"x": uplot.Scale(time=False), "y": uplot.Scale(auto=True)},
                    legend=uplot.Legend(show=False),
                    height=150,
                )
            elif len(self.charts[title].series) != len(series):
                self.charts[title].series = series
            self.charts[title].data = data


def _series(name: str, color: str) -> uplot.Series:
    return uplot.Series(label=name, stroke=color, width=1.5)


def quantities(
    robot: Robot, frames: Sequence[Frame]
) -> dict[str, dict[str, np.ndarray]]:
    """The lines of each chart by their names; joints are those of the first arm.

    Args:
        robot: The arm.
        frames: A history with the same controllers throughout.
    """
    names = [f"{k + 1} {name}" for k, name in enumerate(frames[0].controllers)]
    arms = [[frame.arms[k] for frame in frames] for k in range(len(names))]
    q, qd, tau = (
        np.array([getattr(arm, name) for arm in arms[0]]) for name in ("q", "qd", "tau")
    )
    room = np.minimum(q - robot.q_lower, robot.q_upper - q)

    def of_arms(quantity: str) -> dict[str, np.ndarray]:
        return {
            name: np.array([getattr(arm, quantity) for arm in each])
            for name, each in zip(names, arms, strict=True)
        }

    def of_joints(values: np.ndarray) -> dict[str, np.ndarray]:
        return {
            joint: line
            for joint, line in zip(robot.joint_names, values.T, strict=True)
            if np.isfinite(line).all()
        }

    clear = {name: 1e3 * line for name, line in of_arms("clearance").items()}
    if robot.qd_max is None:
        speeds = {"joint speeds [rad/s]": of_joints(qd)}
    else:
        speeds = {"joint speed / limit": of_joints(np.abs(qd) / robot.qd_max)}
    return {
        "clearance [mm]": {
            name: np.where(np.isfinite(line), line, np.nan)
            for name, line in clear.items()
        },
        "contact force [N]": of_arms("force"),
        "room to joint limits [rad]": of_joints(room),
        **speeds,
        "torque / limit": of_joints(np.abs(tau) / robot.tau_max),
        "loop time [ms]": {"step": 1e3 * np.array([frame.cost for frame in frames])},
    }
