"""Sliders for every parameter of the controllers."""

from __future__ import annotations

from typing import Any

from rmp_mjx.viewer.dials import CONTROLLERS
from rmp_mjx.viewer.stage import Stage

MOST = 5.0
"""A slider goes from zero to so many times the default."""


class DialPanel:
    """A folder for each controller, with reset and the same as Python."""

    def __init__(self, page: Stage):
        """Make the controls in the tab that is open."""
        self.page = page
        self.sliders: dict[tuple[str, str], Any] = {}
        self.copy: dict[str, Any] = {}
        self.reset: dict[str, Any] = {}
        gui = page.server.gui
        for name in CONTROLLERS:
            with gui.add_folder(name, expand_by_default=name == "rmp_vices"):
                self.copy[name] = gui.add_button("Copy as Python")
                self.reset[name] = gui.add_button("Reset")
                self._sliders(name)
            self._wire(name)

    def _sliders(self, name: str) -> None:
        for path, value in self.page.session.dials[name].items():
            top = MOST * value if value > 0 else 0.1
            slider = self.page.server.gui.add_slider(
                path.removeprefix("leaves."), 0.0, top, top / 500, value, hint=path
            )
            self.sliders[name, path] = slider

            @slider.on_update
            def _(_, path=path, slider=slider) -> None:
                new = {path: float(slider.value)}
                self.page.order(lambda: self.page.session.dials[name].update(new))

    def _wire(self, name: str) -> None:
        self.copy[name].on_click(lambda _: self.page.order(lambda: self._copy(name)))
        self.reset[name].on_click(lambda _: self.page.order(lambda: self._reset(name)))

    def _copy(self, name: str) -> None:
        gui = self.page.server.gui
        lines = self.page.session.as_python(name, self.page.robot)
        with gui.add_modal(f"{name} as Python") as modal:
            gui.add_markdown(f"```python\n{lines}```")
            gui.add_button("Close").on_click(lambda _: modal.close())

    def _reset(self, name: str) -> None:
        self.page.session.reset_dials(name)
        for path, value in self.page.session.dials[name].items():
            self.sliders[name, path].value = value
