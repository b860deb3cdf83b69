"""Does the loop meet its millisecond? Beside a bare sleep loop, tick about tick.

    python -m benchmarks.jitter --seconds 60 --json FILE

The machine may be shared: what counts is the loop beside the bare one in the same run.
Both run for some seconds in turn, at the same priority.
"""

import dataclasses
import gc
import json
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
import tyro

import rmp_mjx as rmp
from benchmarks.common import machine
from envs import export
from envs.arms import stored
from rmp_mjx import deploy, runtime
from rmp_mjx.deploy.loop import Timing
from rmp_mjx.sim.robot import MujocoBackend

POLICY = "pretrained/trajectory-rmp_vices-panda"
PERIOD = 0.001


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure the loop's timing."""

    seconds: float = 60.0
    """For so long each of the two [s]."""
    folder: Path = Path("build/deploy-demo")
    """Where the exported file goes."""
    realtime: bool = True
    """Ask for real-time priority, and compute in the loop's own thread."""
    json: Path | None = None
    """Write the rows here, too."""


def bare(seconds: float) -> np.ndarray:
    """Intervals of a loop that only sleeps until its next tick [s]."""
    gc.disable()
    ticks = [due := time.perf_counter()]
    end = due + seconds
    while due < end:
        due = max(due + PERIOD, time.perf_counter())
        time.sleep(max(due - time.perf_counter(), 0.0))
        ticks.append(time.perf_counter())
    gc.enable()
    return np.diff(ticks)


def row(name: str, intervals: np.ndarray, work: np.ndarray | None = None) -> dict:
    """Percentiles in milliseconds."""
    found = {
        "name": name,
        "ticks": len(intervals),
        "interval_ms": _milliseconds(intervals),
        "within_1.5_ms": round(float(np.mean(intervals < 1.5 * PERIOD)), 4),
    }
    if work is not None:
        found["work_ms"] = _milliseconds(work)
        found["work_within_1_ms"] = round(float(np.mean(work < PERIOD)), 4)
    return found


def _milliseconds(times: np.ndarray) -> list[float]:
    return [round(1e3 * x, 3) for x in Timing.of(times)]


def main() -> None:
    """Measure, print, write."""
    options = tyro.cli(Options)
    runtime.configure(async_dispatch=not options.realtime)
    options.folder.mkdir(parents=True, exist_ok=True)
    file = options.folder / "jitter.rmp"
    file.unlink(missing_ok=True)
    export.main([POLICY, "--robot", "fr3", "--out", str(file)])
    deployed = deploy.load(file)
    stand = stored()["fr3"]
    arm = rmp.Robot.load("fr3", mount=stand.mount, finger=stand.turn)
    model = arm.mj_model
    model.opt.timestep = PERIOD
    data = mujoco.MjData(model)
    data.qpos[:] = deployed.start
    simulated = MujocoBackend(model, data, deployed.n)
    backend = deploy.CallbackBackend(simulated.read, simulated.write)
    watchdog = deploy.Watchdog(stale=None, late=10.0)
    rng = np.random.default_rng(0)
    intervals, work, sleeps, urgent = [], [], [], False
    while sum(map(len, sleeps)) * PERIOD < options.seconds:
        points = rng.uniform([0.3, -0.2, 0.05], [0.5, 0.2, 0.25], (4, 3))
        policy = deploy.PolicyTargets(deployed, deploy.ViaPoints(points))
        loop = deploy.Loop(deployed, backend, policy, watchdog=watchdog)
        urgent = options.realtime and deploy.hurry()
        loop.run(4.0)
        ticks = loop.log.columns()
        intervals.append(ticks["interval"][1:])
        work.append(ticks["work"])
        sleeps.append(bare(len(ticks["work"]) * PERIOD))
        deploy.relax()
    rows = [
        row("loop", np.concatenate(intervals), np.concatenate(work)),
        row("bare sleep", np.concatenate(sleeps)),
    ]
    for each in rows:
        print(each)
    if options.json:
        about = {
            "command": f"python -m benchmarks.jitter {' '.join(sys.argv[1:])}",
            "machine": machine(),
            "realtime": urgent,
            "rows": rows,
        }
        options.json.write_text(json.dumps(about, indent=1) + "\n")


if __name__ == "__main__":
    main()
