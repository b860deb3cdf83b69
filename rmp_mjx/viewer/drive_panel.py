"""The panel for who drives, how stiffly, what pulls, and time."""

from __future__ import annotations

from rmp_mjx.viewer.clock_panel import ClockPanel
from rmp_mjx.viewer.dials import CONTROLLERS
from rmp_mjx.viewer.session import KP
from rmp_mjx.viewer.spring import Spring
from rmp_mjx.viewer.stage import Stage

NOBODY = "nobody"


class DrivePanel:
    """Controllers, time, stiffness, the spring."""

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
        self.spring = Spring(page)
        self.pushed = gui.add_dropdown("Pull the link", bodies, initial_value=NOBODY)
        self.release = gui.add_button("Let go")
        self._wire()

    def say(self, words: str) -> None:
        """Show a line of status."""
        self.status.content = words

    def _wire(self) -> None:
        page = self.page
        for control in (self.driver, self.rival):
            control.on_update(lambda _: page.order(self._drive))
        self.pushed.on_update(lambda _: page.order(self._pull))
        self.release.on_click(lambda _: page.order(self.let_go))
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

    def _pull(self) -> None:
        chosen = self.pushed.value
        self.spring.choose("" if chosen == NOBODY else chosen)

    def let_go(self) -> None:
        """Pull no link any more."""
        self.spring.release()
        self.pushed.value = NOBODY

    def _home(self) -> None:
        self.page.session.start()
        self.let_go()
        self.page.player.shown = None
        if self.page.player.paused:
            self.clock.toggle()
