"""Kept episodes in the browser: `python -m rmp_mjx.viewer --episode FILE`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rmp_mjx import runtime
from rmp_mjx.training.runs import policies, run_folder

from . import worst
from .play import Moment
from .task_page import TaskPage


class Episode:
    """A kept episode as a simulation, which goes on until its end and waits there."""

    def __init__(self, kept: worst.Kept):
        """Begin at the moment to look at; what was before is the history."""
        self.period = kept.env.dt
        first, *others = kept.states
        self.moments = [Moment(first, kept.about["episode"], 0.0, {}, 0)]
        for state in others:
            self.moments.append(self.moments[-1].then(state))
        self.history = self.moments[: kept.opened + 1]

    def step(self) -> Moment:
        """The next moment; the last one again at the end."""
        self.history = self.moments[: len(self.history) + 1]
        return self.history[-1]

    def restore(self, frame: Moment) -> None:
        """Go on from a moment."""
        self.history = self.moments[: frame.steps + 1]


class EpisodePage(TaskPage):
    """One of several kept episodes, opened at the moment it happened."""

    def __init__(self, files: Sequence[Path], port: int, folder: Path):
        """Start the server with the first file.

        Args:
            files: Episodes of one task.
            port: Where the page is; the next free one if it is taken.
            folder: Where recordings go.

        Raises:
            ValueError: A file is none of an episode.
        """
        runtime.configure()
        kept = worst.load(files[0])
        title = f"Worst episodes: {kept.env.options.title}"
        super().__init__(Episode(kept), kept.env, title, port, folder)
        self._labels = {_label(file): file for file in files}
        gui = self.server.gui
        self.which = gui.add_dropdown("Episode", list(self._labels))
        self.moment = gui.add_button("To the moment it happened")
        self.beginning = gui.add_button("From the beginning")
        self.happened = gui.add_markdown("")
        self.which.on_update(lambda _: self.order(self._choose))
        self.moment.on_click(lambda _: self.order(self.show_moment))
        self.beginning.on_click(lambda _: self.order(self.start_over))
        self.open(kept)

    def open(self, kept: worst.Kept) -> None:
        """Show another episode of the task, at the moment it happened."""
        self.kept = kept
        about = kept.about
        lines = [f"* {name}: {t:.2f} s" for name, t in about["moments"].items()]
        self.happened.content = "\n".join(
            [
                f"Least clearance {1e3 * about['clearance']:.1f} mm, "
                f"return {about['return']:.1f}. First moments of\n",
                *lines,
            ]
        )
        self.show_moment()

    def show_moment(self) -> None:
        """Go to the moment to look at, paused."""
        self.player.simulation = Episode(self.kept)
        self.player.paused = True
        self.clock.to_now()
        self.player.look_back(0.0)

    def start_over(self) -> None:
        """Play from the start."""
        episode = Episode(self.kept)
        episode.restore(episode.moments[0])
        self.player.simulation, self.player.paused = episode, False
        self.clock.to_now()

    def intent(self, frame: Moment) -> Any:
        """The action that was taken at a moment, (m,)."""
        return frame.state.info["action"]

    def _choose(self) -> None:
        self.open(worst.load(self._labels[self.which.value], self.env))


def _label(file: Path) -> str:
    """An episode in one line: its number, what is worst, and of which seed."""
    about = worst.about(file)
    happened = [n for n in about["moments"] if n != worst.CLEARANCE]
    what = happened[0] if happened else f"{1e3 * about['clearance']:.0f} mm"
    parent = file.parent.parent
    seed = f", seed {parent.name}" if parent.parent.name == run_folder.SEEDS else ""
    return f"{about['episode']}: {what}, {about['opened']:.2f} s{seed}"


def of_run(run: str) -> list[Path]:
    """The kept episodes of a run or a policy, the one with the least clearance first.

    Raises:
        ValueError: There is no such run, or it has none.
    """
    folder = policies.results_of(policies.find(run))
    places = [folder, *sorted(folder.glob(f"{run_folder.SEEDS}/*"))]
    files = [f for p in places for f in sorted((p / run_folder.WORST).glob("*.npz"))]
    if not files:
        raise ValueError(
            f"{folder} has no worst episodes: `python eval.py --run {run}` keeps them"
        )
    return sorted(files, key=lambda file: worst.about(file)["clearance"])
