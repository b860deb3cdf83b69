"""The panel for who drives, how stiffly, what pushes, and time."""

from __future__ import annotations

import numpy as np

from rmp_mjx.viewer.clock_panel import ClockPanel
from rmp_mjx.viewer.dials import CONTROLLERS
from rmp_mjx.viewer.session import KP
from rmp_mjx.viewer.stage import Stage

NOBODY = "nobody"
STRONGEST = 60.0
"""Its greatest force [N]."""


class DrivePanel:
    """Controllers, time, stiffness, push."""

    def __init__(self, page: Stage):
        """Make the controls in the tab that is open."""
        self.page = page
        gui, names = page.server.gui, list(CONTROLLERS)
        self.status = gui.add_markdown("compiling the controllers ...")
        first = page.session.controllers
        self.driver = gui.add_dropdown("Controller", names, initial_value=first[0])
        self.rival = gui.add_dropdown(
            "Beside it",
            [NOBODY, *names],
            initial_value=first[1] if len(first) > 1 else NOBODY,
        )
        self.home = gui.add_button("Start again")
        self.clock = ClockPanel(page)
        self.kp_pos = gui.add_slider("Stiffness", 10.0, 600.0, 5.0, KP)
        self.kp_ori = gui.add_slider("Turning stiffness", 10.0, 600.0, 5.0, KP)
        bodies = [NOBODY, *page.session.robot.body_names]
        self.pushed = gui.add_dropdown("Push the link", bodies, initial_value=NOBODY)
        self.force = gui.add_slider("Push along", 0.0, STRONGEST, 1.0, 20.0)
        self.toward = gui.add_dropdown("Direction", ["x", "y", "z", "-x", "-y", "-z"])
        self._wire()

    def say(self, words: str) -> None:
        """Show a line of status."""
        self.status.content = words

    def _wire(self) -> None:
        page = self.page
        for control in (self.driver, self.rival):
            control.on_update(lambda _: page.order(self._drive))
        for control in (self.pushed, self.force, self.toward):
            control.on_update(lambda _: page.order(self._push))
        for name, control in {"kp_pos": self.kp_pos, "kp_ori": self.kp_ori}.items():

            @control.on_update
            def _(_, name=name, control=control) -> None:
                page.order(lambda: page.session.stiffness.update({name: control.value}))

        self.home.on_click(lambda _: page.order(self._home))

    def _drive(self) -> None:
        names = [self.driver.value]
        if self.rival.value != NOBODY:
            names.append(self.rival.value)
        self.page.session.drive(names)

    def _push(self) -> None:
        if self.pushed.value == NOBODY:
            self.page.session.push = None
            return
        axis = np.eye(3)["xyz".index(self.toward.value[-1])]
        sign = -1.0 if self.toward.value.startswith("-") else 1.0
        self.page.session.push = self.pushed.value, sign * self.force.value * axis

    def _home(self) -> None:
        self.page.session.start()
        self.page.player.shown = None
        if self.page.player.paused:
            self.clock.toggle()
