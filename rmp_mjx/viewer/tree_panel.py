"""The panel for what the tree thinks: what of it is drawn, and its bars."""

from __future__ import annotations

from typing import Any

from rmp_mjx.viewer import texts
from rmp_mjx.viewer.drawing import Thoughts
from rmp_mjx.viewer.insight import Insight
from rmp_mjx.viewer.loop import Loop

_SLOW = 6
"""The bars change with every so many pictures."""


class TreePanel:
    """The tree's thoughts: drawn in the scene, as users choose, and as bars."""

    def __init__(self, page: Loop[Any], thoughts: Thoughts, on: bool = True):
        """Make the controls where the page's panel is built now.

        Args:
            page: The page.
            thoughts: In its scene.
            on: Whether they are drawn at first.
        """
        self.thoughts, self._pictures = thoughts, 0
        gui = page.server.gui
        for label, name in {
            "Control points by weight": "show_points",
            "The gap": "show_gap",
            "Pulls of the leaves": "show_pulls",
        }.items():
            setattr(thoughts, name, on)
            box = gui.add_checkbox(label, on)

            @box.on_update
            def _(_, box=box, name=name) -> None:
                page.order(lambda: setattr(thoughts, name, box.value))

        self.bars = gui.add_html("")

    def show(self, insight: Insight, watched: str) -> None:
        """Draw what the tree thinks now.

        Args:
            insight: What it thinks.
            watched: Who drives the arm.
        """
        self.thoughts.show(insight)
        if self._pictures % _SLOW == 0:
            self.bars.content = texts.bars(insight, watched)
        self._pictures += 1

    def hide(self) -> None:
        """Draw nothing."""
        self.thoughts.hide()
        if self.bars.content:  # else every picture would send it anew
            self.bars.content, self._pictures = "", 0
