"""The loop: read, decide, write, a thousand times a second."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rmp_mjx.deploy.backends import Backend
from rmp_mjx.deploy.deployed import Deployed
from rmp_mjx.deploy.log import RingLog, check_writable
from rmp_mjx.deploy.pilot import PHASES, RATE, Pilot
from rmp_mjx.deploy.sources import ObstacleSource
from rmp_mjx.deploy.targets import Targets
from rmp_mjx.deploy.watchdog import Watchdog


class Timing(NamedTuple):
    """Percentiles of a time, over ticks [s]."""

    p50: float
    """Median."""
    p99: float
    """Of a hundred ticks one is longer."""
    p999: float
    """Of a thousand ticks one is longer."""
    worst: float
    """The longest."""

    @staticmethod
    def of(times: np.ndarray) -> Timing:
        """Of these times [s]."""
        if not len(times):
            return Timing(*[float("nan")] * 4)
        ends = np.percentile(times, [50.0, 99.0, 99.9, 100.0])
        return Timing(*(float(x) for x in ends))


class Report(NamedTuple):
    """How a loop went."""

    reason: str | None
    """Why the arm was stopped; None: as it was told to."""
    held: bool
    """Whether the arm was at rest, held, when the loop ended."""
    ticks: int
    """Ticks."""
    interval: Timing
    """From tick to tick, of the ticks that the log keeps."""
    work: Timing
    """From the state to the torque, likewise."""
    on_time: float
    """Share of them in which that took less than the period."""
    torque: float
    """Greatest torque, as a share of its limit."""
    torque_rate: float
    """Greatest torque rate, as a share of its limit; 0 where there is none."""
    speed: float
    """Greatest joint speed, as a share of its limit; 0 where there is none."""
    clearance: float
    """Least distance to an obstacle, as the controller was told of them [m]."""


class Loop:
    """State in, torque out, at the period of the exported file.

    Everything is compiled when the loop is made. `run` blocks; any thread may call
    `stop`, put obstacles, and read `pilot.phase`.
    """

    def __init__(
        self,
        deployed: Deployed,
        backend: Backend,
        targets: Targets,
        obstacles: ObstacleSource | None = None,
        watchdog: Watchdog | None = None,
        log: str | Path | None = None,
        keep: float = 60.0,
        rate: float = RATE,
    ):
        """Compile it.

        Args:
            deployed: The file, from `load`.
            backend: The robot.
            targets: Where the set-points come from.
            obstacles: Where the obstacles come from; default: there are none, for ever.
            watchdog: Bounds; default the usual ones.
            log: Parquet file to write at the end.
            keep: Time that the log keeps [s].
            rate: Share of the torque rate's limit that is sent. A robot at the end of a
                network may take two torques in one of its ticks, so less than half.

        Raises:
            ImportError: There is to be a log, and polars is not installed.
        """
        if log is not None:
            check_writable()
        if obstacles is None:
            obstacles = ObstacleSource(deployed.obstacles())
            watchdog = watchdog or Watchdog(stale=None)
        self.deployed, self.backend = deployed, backend
        self.pilot = Pilot(deployed, obstacles, targets, watchdog, rate)
        self._path = None if log is None else Path(log)
        self.log = RingLog(deployed.n, round(keep / deployed.period))
        self._stop = threading.Event()
        self.error: Exception | None = None

    def stop(self) -> None:
        """Bring the arm to rest, hold it, and end the loop."""
        self._stop.set()

    def run(
        self,
        seconds: float = float("inf"),
        until: Callable[[], bool] = lambda: False,
        hold: float = 0.5,
    ) -> Report:
        """Control the robot until it is held at rest.

        Args:
            seconds: Stop after so much time.
            until: Stop when this is true; asked at every tick.
            hold: Hold the arm for so long before the loop ends [s].

        Raises:
            ValueError: The first state is not one to start from. What the targets raise
                at the start is raised, too.
        """
        collecting = gc.isenabled()
        gc.collect()
        gc.disable()
        try:
            self._run(seconds, until, hold)
        finally:
            if collecting:
                gc.enable()
            if self._path is not None:
                self.log.write(self._path)
        return self.report()

    def _run(self, seconds: float, until: Callable[[], bool], hold: float) -> None:
        """All ticks; an error of the robot's own ends them."""
        pilot, backend, period = self.pilot, self.backend, self.deployed.period
        clock = time.perf_counter
        begin = last = due = clock()
        held = 0.0
        while True:
            if backend.pace == "loop":
                due = max(due + period, clock())  # never two at once
                _sleep_until(due)
            try:
                q, qd = backend.read()
            except Exception as error:
                self._lost(error)
                return
            now = clock()
            interval = period if pilot.ticks == 0 else now - last
            simulated = backend.pace == "simulation"
            tau = pilot.step(q, qd, period if simulated else interval)
            sent = tau - pilot.gravity if backend.carries_weight else tau
            held = held + period if pilot.phase == "held" else 0.0
            done = held >= hold
            try:
                (backend.finish if done else backend.write)(sent)
            except Exception as error:
                self._lost(error)
                return
            self.log.add(
                time=now - begin,
                interval=interval,
                work=clock() - now,
                q=q if q.shape == tau.shape else np.nan,
                qd=qd if qd.shape == tau.shape else np.nan,
                tau=tau,
                tau_ext=pilot.out["tau_ext"],
                clearance=pilot.out["clearance"],
                obstacle_age=pilot.age,
                phase=PHASES.index(pilot.phase),
            )
            last = now
            if done:
                return
            if self._stop.is_set() or pilot.time + period >= seconds or until():
                pilot.stop()

    def _lost(self, error: Exception) -> None:
        """The robot does not answer, or has stopped itself."""
        self.error = error
        self.pilot.fault(f"the robot: {error}")

    def report(self) -> Report:
        """How it went so far."""
        ticks, limits = self.log.columns(), self.deployed.limits
        slopes = np.abs(np.diff(ticks["tau"], axis=0)) / self.deployed.period
        met = ticks["work"] < self.deployed.period
        return Report(
            reason=self.pilot.reason,
            held=self.pilot.phase == "held",
            ticks=self.log.count,
            interval=Timing.of(ticks["interval"][1:]),
            work=Timing.of(ticks["work"]),
            on_time=float(np.mean(met)) if len(met) else 1.0,
            torque=_most(ticks["tau"] / limits.tau),
            torque_rate=_most(slopes / limits.tau_rate),
            speed=_most(ticks["qd"] / limits.qd),
            clearance=float(np.min(ticks["clearance"], initial=np.inf)),
        )


def _most(x: np.ndarray) -> float:
    return float(np.max(np.abs(x), initial=0.0))


def _sleep_until(due: float) -> None:
    """Sleep, then spin for the last 0.1 ms, which a sleep would miss."""
    left = due - time.perf_counter()
    if left > 2e-4:
        time.sleep(left - 1e-4)
    while time.perf_counter() < due:
        pass
