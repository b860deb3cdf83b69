"""A trained policy on an FR3 through the robot's own bindings, against a server.

The server is `franka-sim` (PyPI): it speaks the robot's network protocol and has MuJoCo
inside. It is as strict as the robot about late commands and about limits. `make
deploy-demo` installs it and the bindings, pylibfranka, and runs this.

Both share the cores of this machine, which has no real-time kernel, so that a show may
be cut off by lost commands. It is then done again with a fresh server, and the table
says how often and why. Loop and server have real-time priority where that is allowed.
"""

import contextlib
import dataclasses
import json
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import tyro

import rmp_mjx as rmp
from benchmarks.common import machine
from envs import export
from envs.arms import stored
from envs.trajectory import BOX_HIGH, BOX_LOW
from rmp_mjx import deploy, runtime
from rmp_mjx.deploy.franka import FrankaBackend, WrongRobotError
from rmp_mjx.deploy.pilot import PHASES
from rmp_mjx.sim.robot import MujocoBackend

POLICY = "pretrained/trajectory-rmp_vices-panda"
ADDRESS = "127.0.0.1"
AT = ADDRESS, 1337
RATE = 0.45
"""Share of the torque rate's limit: two torques in one tick of the robot are within."""
ATTEMPTS = 5
"""A show is tried so often."""
DRIFT = 5.0
"""A joint that holds itself may move so far in three seconds [mrad]."""
OVER = np.array([0.05, 0.0, 0.1])
"""Spheres may be so far beyond the via points' box [m]."""
TABLE: dict[str, Any] = {"point": [[0.0, 0.0, -0.112]], "normal": [[0.0, 0.0, 1.0]]}


@dataclasses.dataclass(frozen=True)
class Options:
    """Run the demo."""

    server: Path = Path("build/franka-sim/bin/run-franka-sim-server")
    """The server's command."""
    folder: Path = Path("build/deploy-demo")
    """Where the exported file and the logs go."""
    episodes: int = 10
    """Episodes; every second one has a sphere on the way."""
    late: float = 0.1
    """Lateness of a tick that stops the arm [s]; a robot's own machine takes 0.01."""
    seed: int = 0
    """Seed of the via points."""
    json: Path | None = None
    """Write the rows here, too."""


class Server:
    """The robot's side, with our FR3 and the tasks' finger in it."""

    def __init__(self, options: Options):
        """Start it."""
        model = options.folder / "fr3.xml"
        model.write_text(rmp.Robot.load("fr3", finger=stored()["fr3"].turn).mjcf)
        strict = ["--enforce-comm-constraints", "--enforce-motion-limits"]
        with (options.folder / "server.log").open("a") as log:
            self.process = subprocess.Popen(
                [options.server, "--no-gripper", *strict],
                env={**os.environ, "FR3_MJCF": str(model)},
                stdout=log,
                stderr=log,
            )
        try:
            self._wait(options)
        except BaseException:
            self.stop()
            raise
        self.urgent = deploy.hurry(self.process.pid)

    def _wait(self, options: Options) -> None:
        """Wait until it listens."""
        for _ in range(300):
            if self.process.poll() is not None:
                raise RuntimeError(f"the server ended: {options.folder}/server.log")
            with contextlib.suppress(OSError), socket.create_connection(AT):
                break
            time.sleep(0.1)
        time.sleep(2.0)  # it takes the probe for a client, and needs some time

    def stop(self) -> None:
        """End it."""
        self.process.terminate()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class Demo:
    """The robot, the file, and what they show."""

    def __init__(self, options: Options):
        """Export the policy, compile everything, start the server and connect."""
        self.options = options
        self.deployed = deploy.load(self._export("fr3", "--robot", "fr3"))
        self.other = deploy.load(self._export("panda"))
        self.rng = np.random.default_rng(options.seed)
        self.watchdog = deploy.Watchdog(stale=None, late=options.late)
        policy = deploy.PolicyTargets(self.deployed, deploy.ViaPoints(np.zeros((4, 3))))
        self._loop(None, policy, self.source())
        self.server: Server | None = None
        self.connect()

    def _export(self, name: str, *flags: str) -> Path:
        """A file of the policy."""
        file = self.options.folder / f"{name}.rmp"
        file.unlink(missing_ok=True)
        if export.main([POLICY, *flags, "--out", str(file)]):
            raise RuntimeError("the policy could not be exported")
        return file

    def connect(self) -> None:
        """Connect to a fresh server."""
        deploy.relax()
        self.close()
        self.server = Server(self.options)
        self.robot = FrankaBackend(self.deployed, ADDRESS, realtime=False, ahead=True)
        self.urgent = deploy.hurry() and self.server.urgent

    def close(self) -> None:
        """End the server, if there is one."""
        if self.server:
            self.server.stop()

    def source(self, sphere: np.ndarray | None = None) -> deploy.ObstacleSource:
        """The table, and a sphere if there is one."""
        found = deploy.ObstacleSource(self.deployed.obstacles())
        found.put("planes", **TABLE)
        if sphere is not None:
            found.put("spheres", center=[sphere], radius=[0.05])
        return found

    def _loop(self, backend, targets, source, **watchdog) -> deploy.Loop:
        dog = dataclasses.replace(self.watchdog, **watchdog)
        return deploy.Loop(self.deployed, backend, targets, source, dog, rate=RATE)

    def show(self, name: str, act: Callable[[], dict], good: Callable[[dict], bool]):
        """Do it from the start of the task, with a fresh server where it was cut off.

        Args:
            name: For the terminal.
            act: What is shown; its `reason` says why the arm was stopped.
            good: Whether it went as it should.
        """
        aborts, found = [], {}
        while len(aborts) < ATTEMPTS:
            found = {"reason": self.go_to_start().reason}
            if found["reason"] is None:
                found = act()
                if good(found):
                    break
            aborts.append(cause(found["reason"]))
            self.connect()
        passed = len(aborts) < ATTEMPTS
        cut = f", anew after {', '.join(aborts)}" if aborts else ""
        print(f"{name}: {'passed' if passed else 'failed'}{cut}", flush=True)
        return found | {"passed": passed, "aborts": aborts}

    def go_to_start(self) -> deploy.Report:
        """Bring the grip to where the task starts."""
        goal = deploy.ReachTargets(self.deployed, self.deployed.start)
        loop = self._loop(self.robot, goal, self.source())
        return loop.run(8.0, lambda: goal.distance < 0.01)

    def points(self) -> np.ndarray:
        """Via points as in training: in the box, 10 cm apart."""
        while True:
            points = self.rng.uniform(BOX_LOW, BOX_HIGH, (4, 3))
            apart = np.linalg.norm(points[:, None] - points, axis=-1)
            if np.min(apart[~np.eye(4, dtype=bool)]) > 0.10:
                return points

    def sphere(self, points: np.ndarray) -> np.ndarray:
        """Centre of a sphere near the via points' box, 10 cm from all of them.

        The arm has 5 cm to it at the start.
        """
        centers = self.rng.uniform(BOX_LOW, BOX_HIGH + OVER, (500, 3))
        away = np.linalg.norm(centers[:, None] - points, axis=-1).min(axis=1)
        centers = centers[away > 0.10]
        control = self.deployed.flat("control")
        for place, argument in enumerate(self.deployed.examples("control")):
            control.put(place, argument)
        q, none = self.deployed.start, self.source().get()
        control.put(0, q)
        goal = deploy.ReachTargets(self.deployed, q)
        control.put(2, goal(q, np.zeros_like(q), 0.0, none))
        for center in centers:
            control.put(3, self.source(center).get().slots)
            if control()["clearance"] > 0.05:
                return center
        raise RuntimeError("no place for a sphere")

    def fly(self, backend, points: np.ndarray, sphere: np.ndarray | None) -> dict:
        """One episode."""
        via = deploy.ViaPoints(points)
        policy = deploy.PolicyTargets(self.deployed, via)
        loop = self._loop(backend, policy, self.source(sphere))
        report = loop.run(15.0, lambda: via.done)
        return {
            "reached": via.reached,
            "times": [round(float(t), 2) for t in via.times],
            "nearest_cm": [round(100 * float(d), 2) for d in via.nearest],
            "clearance_cm": round(100 * report.clearance, 1),
            "torque": round(report.torque, 3),
            "torque_rate": round(report.torque_rate, 3),
            "speed": round(report.speed, 3),
            "interval_ms": [round(1e3 * t, 2) for t in report.interval],
            "work_ms": [round(1e3 * t, 2) for t in report.work],
            "on_time": round(report.on_time, 4),
            "reason": report.reason,
        }

    def episode(self, number: int) -> Callable[[], dict]:
        """One episode on the server; gives what does it again in our own simulation."""
        points = self.points()
        sphere = self.sphere(points) if number % 2 else None
        q = self.deployed.start

        def act() -> dict:
            nonlocal q
            q, _ = self.robot.look()
            return self.fly(self.robot, points, sphere)

        found = self.show(f"episode {number}", act, visited)
        found |= {"episode": number, "sphere": sphere is not None}

        def again() -> dict:
            stand = stored()["fr3"]
            robot = rmp.Robot.load("fr3", mount=stand.mount, finger=stand.turn)
            model = robot.mj_model
            model.opt.timestep = 0.001
            data = mujoco.MjData(model)
            data.qpos[:] = q
            own = self.fly(MujocoBackend(model, data, 7), points, sphere)
            keep = ("reached", "times", "nearest_cm", "clearance_cm")
            return found | {"own": {k: own[k] for k in keep}}

        return again

    def hold(self) -> dict:
        """Drift of an arm that only holds itself, in three seconds."""
        goal = deploy.ReachTargets(self.deployed, self.robot.look()[0])
        loop = self._loop(self.robot, goal, self.source())
        report, log = loop.run(0.0, hold=3.0), loop.log.columns()
        q = log["q"][log["phase"] == PHASES.index("held")]
        drift = round(1e3 * float(np.max(np.abs(q[-1] - q[0]))), 2) if len(q) else None
        return {"drift_mrad": drift, "reason": report.reason}

    def stale(self, points: np.ndarray) -> dict:
        """The source of obstacles falls silent while the policy moves the arm."""
        policy = deploy.PolicyTargets(self.deployed, deploy.ViaPoints(points))
        loop = self._loop(self.robot, policy, self.source(), stale=0.7)
        report = loop.run(10.0)
        return {"reason": report.reason, "held": report.held}

    def reflex(self) -> dict:
        """Commands stay away; the robot stops itself, and goes on when told to."""
        goal = deploy.ReachTargets(self.deployed, self.deployed.start)

        def sleepy(q, qd, t, seen):
            if t > 0.5:
                time.sleep(0.5)
            return goal(q, qd, t, seen)

        loop = self._loop(self.robot, sleepy, self.source(), late=9.0)
        reason = loop.run(5.0).reason
        if "reflex" not in str(reason):
            return {"reason": reason, "provoked": None}
        self.robot.recover()
        time.sleep(1.0)  # for the arm to settle
        return {"reason": self.hold()["reason"], "provoked": reason}

    def wrong(self) -> dict:
        """A file of another arm is refused."""
        try:
            FrankaBackend(self.other, ADDRESS, realtime=False)
        except WrongRobotError as error:
            return {"refused": str(error), "passed": True}
        return {"refused": None, "passed": False}

    def all(self) -> dict:
        """Every show; the episodes then in our own simulation."""
        found: dict = {"realtime": self.urgent, "wrong_robot": self.wrong()}
        found["hold"] = self.show("hold", self.hold, steady)
        episodes = [self.episode(k) for k in range(self.options.episodes)]
        points = self.points()
        found["stale"] = self.show("stale", lambda: self.stale(points), braked)
        found["reflex"] = self.show("reflex", self.reflex, recovered)
        deploy.relax()
        self.close()
        return found | {"episodes": [again() for again in episodes]}


def visited(found: dict) -> bool:
    """All points visited, nothing touched, stopped as told."""
    clear = found["clearance_cm"] > 0.0
    return found["reached"] == 4 and clear and found["reason"] is None


def steady(found: dict) -> bool:
    """The arm stayed where it was."""
    return found["reason"] is None and found["drift_mrad"] < DRIFT


def braked(found: dict) -> bool:
    """It was stopped for the obstacles, and held."""
    return found["held"] and str(found["reason"]).startswith("obstacles stale")


def recovered(found: dict) -> bool:
    """It stopped itself, and was held by the loop afterwards."""
    return found["provoked"] is not None and found["reason"] is None


def cause(reason: str | None) -> str:
    """Why a show was cut off, in a few words: the robot's own ones if it has any."""
    errors = re.findall(r'"(\w+)"', reason or "")
    return " and ".join(errors) or reason or "not as it should"


def table(rows: list[dict]) -> str:
    """The episodes in Markdown."""
    lines = [
        "| episode | sphere | visited | points after [s] | own simulation [s] "
        "| nearest, own [cm] | clearance, own [cm] | torque | rate "
        "| tick p50, p99, worst [ms] | aborts |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        if "times" not in row:
            lines.append(f"| {row['episode']} | never begun: {row['reason']} |")
            continue
        p50, p99, _, worst = row["interval_ms"]
        own = row["own"]
        lines.append(
            f"| {row['episode']} | {'yes' if row['sphere'] else 'no'} "
            f"| {row['reached']} of 4 | {_list(row['times'])} | {_list(own['times'])} "
            f"| {_list(row['nearest_cm'])}; {_list(own['nearest_cm'])} "
            f"| {row['clearance_cm']}, {own['clearance_cm']} "
            f"| {100 * row['torque']:.0f} % | {100 * row['torque_rate']:.0f} % "
            f"| {p50}, {p99}, {worst} | {len(row['aborts'])} |"
        )
    return "\n".join(lines)


def _list(numbers: list[float]) -> str:
    return ", ".join(f"{x:.2f}" for x in numbers)


def main() -> int:
    """Run everything; 1 if a show failed."""
    options = tyro.cli(Options, config=(tyro.conf.OmitArgPrefixes,))
    runtime.configure(async_dispatch=False)
    options.folder.mkdir(parents=True, exist_ok=True)
    (options.folder / "server.log").unlink(missing_ok=True)
    with contextlib.closing(Demo(options)) as demo:
        found = demo.all()
    rows = found["episodes"]
    shows = {k: found[k] for k in ("wrong_robot", "hold", "stale", "reflex")}
    every = (*shows.values(), *rows)
    aborts = [why for show in every for why in show.get("aborts", ())]
    causes = {why: aborts.count(why) for why in sorted(set(aborts))}
    print(table(rows))
    for name, show in shows.items():
        print(f"{name}: {show}")
    print(f"real-time priority: {found['realtime']}; aborts: {causes or 'none'}")
    if options.json:
        command = "python -m benchmarks.deploy_demo " + " ".join(sys.argv[1:])
        about = {"command": command.strip(), "machine": machine(), "aborts": causes}
        options.json.write_text(json.dumps(about | found, indent=1) + "\n")
    return 0 if all(show["passed"] for show in every) else 1


if __name__ == "__main__":
    sys.exit(main())
