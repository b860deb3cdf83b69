"""Strip charts of the last seconds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
from viser import uplot

from rmp_mjx.robot import Robot
from rmp_mjx.viewer.session import Frame

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
        """Make the charts, empty."""
        self._robot, self._gui = robot, gui
        joints = [f"joint {k + 1}" for k in range(robot.n)]
        arms = ["first arm", "second", "third", "fourth"]
        speeds = "speed / limit" if robot.qd_max is not None else "speeds [rad/s]"
        self._charts = {
            title: self._chart(title, names)
            for title, names in {
                "clearance [mm]": arms,
                "contact force [N]": arms,
                "room to joint limits [rad]": joints,
                f"joint {speeds}": joints,
                "torque / limit": joints,
                "loop time [ms]": ["step"],
            }.items()
        }

    def _chart(self, title: str, names: Sequence[str]) -> viser.GuiUplotHandle:
        series = [uplot.Series(label="t [s]")]
        series += [
            uplot.Series(label=name, stroke=color, width=1.5)
            for name, color in zip(names, _LINES, strict=False)
        ]
        empty = tuple(np.zeros(2) for _ in series)
        return self._gui.add_uplot(
            empty,
            tuple(series),
            title=title,
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(auto=True)},
            legend=uplot.Legend(show=False),
            height=150,
        )

    def show(self, frames: Sequence[Frame]) -> None:
        """Draw the end of a history."""
        if len(frames) < 2:
            return
        shown = frames[::-1][: round(SPAN / 0.005) : _EVERY][::-1]
        time = np.array([frame.time for frame in shown])
        for chart, lines in zip(
            self._charts.values(), quantities(self._robot, shown), strict=True
        ):
            wanted = len(chart.series) - 1
            rows = [*lines, *[np.full(len(time), np.nan)] * wanted][:wanted]
            chart.data = (time, *rows)


def quantities(robot: Robot, frames: Sequence[Frame]) -> list[list[np.ndarray]]:
    """The lines of each chart, in their order; joints are those of the first arm."""
    most = min(len(frame.arms) for frame in frames)
    arms = [[frame.arms[k] for frame in frames] for k in range(most)]
    first = arms[0]
    q, qd, tau = (
        np.array([getattr(arm, name) for arm in first]) for name in ("q", "qd", "tau")
    )
    room = np.minimum(q - robot.q_lower, robot.q_upper - q)
    room = np.where(np.isfinite(room), room, np.nan)
    share = np.abs(tau) / robot.tau_max
    speed = qd if robot.qd_max is None else np.abs(qd) / robot.qd_max
    clear = [np.array([1e3 * arm.clearance for arm in each]) for each in arms]
    clear = [np.where(np.isfinite(x), x, np.nan) for x in clear]
    return [
        clear,
        [np.array([arm.force for arm in each]) for each in arms],
        list(room.T),
        list(speed.T),
        list(share.T),
        [1e3 * np.array([frame.cost for frame in frames])],
    ]
