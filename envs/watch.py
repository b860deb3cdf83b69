"""A training that is going on, in the browser: `train.py --watch`."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import polars as pl
from rich.console import Console
from viser import uplot

from rmp_mjx import runtime
from rmp_mjx.training.config import ConfigError, TrainConfig
from rmp_mjx.training.learning.networks import Agent, zero_agent
from rmp_mjx.training.runs import policies, run_folder
from rmp_mjx.training.runs.checkpoint import CheckpointError
from rmp_mjx.training.runs.metrics import SEED

from . import cli
from .play import BY_HAND, Play, task_with_room
from .view import PolicyPage

PICTURES = 10.0
"""Pictures per second: few, the processor belongs to the training."""
LOOK = 3.0
"""Time from one look into the run's folder to the next [s]."""


class WatchPage(PolicyPage):
    """One environment with the newest policy of a run, and the run's curves."""

    frames = PICTURES

    def __init__(
        self,
        play: Play,
        config: TrainConfig,
        run: Path,
        port: int,
        folder: Path,
    ):
        """Start the server.

        Args:
            play: One environment.
            config: Configuration of the run.
            run: Its folder.
            port: Where the page is; the next free one if it is taken.
            folder: Where recordings go.
        """
        super().__init__(play, f"Training: {config.title}", port, folder)
        self.config, self.run_folder = config, run
        self.policy = self.server.gui.add_markdown("no checkpoint yet: no torque")
        self.charts: dict[str, Any] = {}
        self.iterations, self._seen, self._since = 0, 0.0, LOOK
        self._loading: threading.Thread | None = None

    def tick(self, elapsed: float) -> None:
        """Look into the folder now and then; play while somebody looks at the page."""
        self._since += elapsed
        if self._since >= LOOK:
            self._since = 0.0
            self.look()
        if self.watched():
            super().tick(elapsed)

    def watched(self) -> bool:
        """Whether the page is open in a browser."""
        return bool(self.server.get_clients())

    def look(self) -> None:
        """Show what is new in the run's folder."""
        path = self.run_folder / run_folder.METRICS
        changed = path.stat().st_mtime if path.exists() else 0.0
        if changed > self._seen:
            self._seen = changed
            self.show_curves(pl.read_parquet(path))
        idle = self._loading is None or not self._loading.is_alive()
        if idle and newest(self.run_folder) > self.iterations:
            self._loading = threading.Thread(target=self._load, daemon=True)
            self._loading.start()

    def _load(self) -> None:
        """Read the newest policy, while the page goes on."""
        with contextlib.suppress(CheckpointError, ConfigError, OSError):
            found = policies.load_agent(
                self.env, self.config, self.run_folder, True, lambda line: None
            )
            self.order(lambda: self.take(*found))

    def take(self, iterations: int, agent: Agent) -> None:
        """Let another policy act from now on."""
        self.iterations, self.play.agent = iterations, agent
        self.policy.content = f"policy of iteration {iterations}"

    def show_curves(self, rows: pl.DataFrame) -> None:
        """Draw the curves that the terminal's line has; of several seeds, the first."""
        if SEED in rows.columns:
            rows = rows.filter(pl.col(SEED) == rows[SEED][0])
        shown = ["episode/return"]
        shown += [m.column for m in self.env.metrics.values() if m.headline]
        steps = rows["steps"].cast(pl.Float64).to_numpy()
        for name in dict.fromkeys(shown):
            if name not in rows.columns or len(steps) < 2:
                continue
            line = rows[name].cast(pl.Float64).fill_null(float("nan")).to_numpy()
            if name in self.charts:
                self.charts[name].data = steps, line
                continue
            self.charts[name] = self.server.gui.add_uplot(
                (steps, line),
                (uplot.Series(label="policy steps"), uplot.Series(stroke="#1a6ebe")),
                title=name.split("/")[-1].replace("_", " "),
                scales={"x": uplot.Scale(time=False), "y": uplot.Scale(auto=True)},
                legend=uplot.Legend(show=False),
                height=150,
            )


def newest(run: Path) -> int:
    """Iterations of the newest finished checkpoint of a run; 0: there is none."""
    place = run / run_folder.CHECKPOINTS
    names = [path.name for path in place.iterdir()] if place.is_dir() else []
    return max((int(name) for name in names if name.isdigit()), default=0)


def give_way() -> None:
    """Run only where the processor has nothing else to do."""
    os.nice(19)
    if hasattr(os, "SCHED_IDLE"):
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


@contextlib.contextmanager
def watching(
    run: Path, config: TrainConfig, console: Console
) -> Iterator[subprocess.Popen[bytes]]:
    """Start a page for a run in a process of its own; it ends with this one.

    The page's process holds the other end of a pipe. However this process ends, the
    pipe closes, and the page with it. The page writes nothing into it: however that
    one ends, the training goes on.

    Yields:
        The page's process.
    """
    command = [sys.executable, "-m", "rmp_mjx.viewer", "--run", str(run), "--watch"]
    command += ["--leash", "--env", config.task.env]
    page = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)
    console.print("the page of this training opens when its first row is written")
    try:
        yield page
    finally:
        assert page.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            page.stdin.close()
        try:
            page.wait(10.0)
        except subprocess.TimeoutExpired:
            page.kill()
            page.wait()


def page(
    args: Sequence[str], port: int, folder: Path, leash: bool = False
) -> WatchPage | None:
    """The page of a run that is watched; None: its training has ended already.

    Args:
        args: Flags of `eval.py`: the run, and its task's name.
        port: Where the page is.
        folder: Where recordings go.
        leash: End when the standard input does.

    Raises:
        ValueError: There is no such run.
    """
    give_way()
    ended = threading.Event()
    if leash:
        threading.Thread(target=_hold, args=(ended,), daemon=True).start()
    run = Path(args[args.index("--run") + 1])
    while leash and not (run / run_folder.METRICS).exists():
        if ended.wait(0.5):
            return None
    options, config = cli.parse_eval(args)
    if config is None or not run.is_dir():
        raise ConfigError(f"{run} is no run folder: --watch follows a training")
    runtime.configure()
    env = task_with_room(options.task)
    play = Play(env, zero_agent(env.action_size), options.seed, BY_HAND)
    found = WatchPage(play, config, run, port, folder)
    if leash:
        threading.Thread(target=_end, args=(ended, found), daemon=True).start()
    return found


def _hold(ended: threading.Event) -> None:
    """Wait for the end of the standard input."""
    while sys.stdin.buffer.read(1):
        pass
    ended.set()


def _end(ended: threading.Event, page: WatchPage) -> None:
    ended.wait()
    page.stop()
