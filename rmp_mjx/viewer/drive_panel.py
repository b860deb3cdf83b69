"""The panel for who drives, how stiffly, and the clock."""

from __future__ import annotations

import numpy as np

from rmp_mjx.viewer.dials import CONTROLLERS
from rmp_mjx.viewer.session import KP, REMEMBERED
from rmp_mjx.viewer.stage import Stage

SPEEDS = ("1", "1/2", "1/4", "1/10")
"""Simulated seconds per second."""
NOBODY = "nobody"
SPRING = 200.0
"""Stiffness of the hand that pushes [N/m]."""
STRONGEST = 60.0
"""Its greatest force [N]."""


class DrivePanel:
    """Controllers, stiffness, push, pause, slow motion, history, recording."""

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
        self.pause = gui.add_button("Pause")
        self.once = gui.add_button("One step")
        self.speed = gui.add_dropdown("Speed", SPEEDS)
        self.back = gui.add_slider("Seconds ago", 0.0, REMEMBERED, 0.05, 0.0)
        self.again = gui.add_button("Go on from there")
        self.record = gui.add_button("Record")
        self.saved = gui.add_markdown("")
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
        self.pause.on_click(lambda _: page.order(self._pause))
        self.once.on_click(lambda _: page.order(self._once))
        self.speed.on_update(lambda _: page.order(self._speed))
        self.back.on_update(lambda _: page.order(self._back))
        self.again.on_click(lambda _: page.order(self._again))
        self.record.on_click(lambda _: page.order(self._record))

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
        self.page.frame = None
        self._set_paused(False)

    def _pause(self) -> None:
        self._set_paused(not self.page.paused)

    def _set_paused(self, paused: bool) -> None:
        self.page.paused = paused
        self.pause.label = "Go on" if paused else "Pause"
        if not paused:
            self.page.back = 0.0
            if self.back.value:
                self.back.value = 0.0

    def _once(self) -> None:
        self._set_paused(True)
        self.page.step_once()

    def _speed(self) -> None:
        top, _, bottom = self.speed.value.partition("/")
        self.page.speed = float(top) / float(bottom or 1)

    def _back(self) -> None:
        if self.back.value:
            self._set_paused(True)
        self.page.back = float(self.back.value)

    def _again(self) -> None:
        if self.page.frame is not None:
            self.page.session.restore(self.page.frame)
        self._set_paused(False)

    def _record(self) -> None:
        recording = self.page.recording
        if recording.on:
            path = recording.save()
            self.saved.content = f"Saved `{path}`"
            self.record.label = "Record"
        else:
            recording.start()
            self.record.label = "Stop and save"
            self.saved.content = ""
