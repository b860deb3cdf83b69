"""The panel for time: pause, one step, slow motion, history, recording."""

from __future__ import annotations

import threading
from typing import Any

from rmp_mjx.viewer import film
from rmp_mjx.viewer.loop import Loop
from rmp_mjx.viewer.player import REMEMBERED

SPEEDS = ("1", "1/2", "1/4", "1/10")
"""Simulated seconds per second."""


class ClockPanel:
    """The controls of a page's player and of its recording."""

    def __init__(self, page: Loop[Any]):
        """Make the controls where the page's panel is built now."""
        self.page, self.player = page, page.player
        gui = page.server.gui
        self.pause = gui.add_button("Pause")
        self.once = gui.add_button("One step")
        self.speed = gui.add_dropdown("Speed", SPEEDS)
        self.back = gui.add_slider("Seconds ago", 0.0, REMEMBERED, 0.05, 0.0)
        self.again = gui.add_button("Go on from there")
        self.record = gui.add_button("Record")
        self.film = gui.add_button(f"Film of the last {film.SECONDS:g} s")
        self.saved = gui.add_markdown("")
        self.pause.on_click(lambda _: page.order(self.toggle))
        self.once.on_click(lambda _: page.order(self.step_once))
        self.again.on_click(lambda _: page.order(self.go_on_from_there))
        self.record.on_click(lambda _: page.order(self.start_or_save))
        self.film.on_click(lambda _: page.order(self.make_film))
        self.speed.on_update(lambda _: page.order(self._turn))
        self.back.on_update(lambda _: page.order(self._look_back))

    def show(self) -> None:
        """Name the buttons after what they do now."""
        _name(self.pause, "Go on" if self.player.paused else "Pause")
        _name(self.record, "Stop and save" if self.page.recording.on else "Record")

    def toggle(self) -> None:
        """Pause, or go on from the newest frame."""
        self.player.paused = not self.player.paused
        self.to_now()

    def step_once(self) -> None:
        """Pause, and go on by one step."""
        self.player.once()
        self.to_now()

    def go_on_from_there(self) -> None:
        """Go on from what is shown."""
        self.player.go_on_from_there()
        self.to_now()

    def start_or_save(self) -> None:
        """Start a recording, or end it as a file."""
        recording = self.page.recording
        if recording.on:
            self.saved.content = f"Saved `{recording.save()}`"
        else:
            recording.start()
            self.saved.content = ""

    def make_film(self) -> threading.Thread:
        """Make an MP4 in a thread of its own: the page goes on."""

        def work() -> None:
            try:
                path = film.make(self.player.simulation, page.render, page.folder)
                said = f"Saved `{path}`"
            except ValueError as error:
                said = f"**{error}**"
            page.order(lambda: self._say(said))

        page = self.page
        self.saved.content = "drawing a film ..."
        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        return thread

    def _say(self, text: str) -> None:
        self.saved.content = text

    def to_now(self) -> None:
        """Put the slider back."""
        if self.back.value:
            self.back.value = 0.0

    def _turn(self) -> None:
        top, _, bottom = self.speed.value.partition("/")
        self.player.speed = float(top) / float(bottom or 1)

    def _look_back(self) -> None:
        self.player.look_back(float(self.back.value))


def _name(button: Any, label: str) -> None:
    if button.label != label:
        button.label = label
