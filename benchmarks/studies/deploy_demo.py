"""A trained policy on an FR3 through the robot's own bindings, against a server.

The server is `franka-sim` (PyPI): it speaks the robot's network protocol and has MuJoCo
inside. It is as strict as the robot about late commands and about limits. `make
deploy-demo` installs it and the bindings, pylibfranka, and runs this.
"""

import contextlib
import dataclasses
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
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
"""An episode is begun anew so often, where the robot stops itself or a tick is late."""
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


@contextlib.contextmanager
def serving(options: Options) -> Iterator[None]:
    """The server, with our FR3 and the tasks' finger in it."""
    model = options.folder / "fr3.xml"
    model.write_text(rmp.Robot.load("fr3", finger=stored()["fr3"].turn).mjcf)
    strict = ["--enforce-comm-constraints", "--enforce-motion-limits"]
    with (options.folder / "server.log").open("w") as log:
        server = subprocess.Popen(
            [options.server, "--no-gripper", *strict],
            env={**os.environ, "FR3_MJCF": str(model)},
            stdout=log,
            stderr=log,
        )
    try:
        for _ in range(300):
            if server.poll() is not None:
                raise RuntimeError(f"the server ended: {options.folder}/server.log")
            with (
                contextlib.suppress(OSError),
                socket.create_connection(AT),
            ):
                break
            time.sleep(0.1)
        time.sleep(2.0)  # it takes the probe for a client, and needs some time
        yield
    finally:
        server.terminate()
        server.wait(30)


class Demo:
    """The robot, the file, and what they do."""

    def __init__(self, options: Options):
        """Export the policy and connect."""
        self.options = options
        file = options.folder / "fr3.rmp"
        file.unlink(missing_ok=True)
        if export.main([POLICY, "--robot", "fr3", "--out", str(file)]):
            raise RuntimeError("the policy could not be exported")
        self.deployed = deploy.load(file)
        self.rng = np.random.default_rng(options.seed)
        self.watchdog = deploy.Watchdog(stale=None, late=options.late)
        policy = deploy.PolicyTargets(self.deployed, deploy.ViaPoints(np.zeros((4, 3))))
        self._loop(None, policy, self.source())  # compiles everything

    def connect(self) -> None:
        """Connect to the server."""
        self.robot = FrankaBackend(self.deployed, ADDRESS, realtime=False)

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

    def _run(self, loop: deploy.Loop, seconds: float, until=None) -> deploy.Report:
        """Run a loop; after a reflex the robot is told to go on."""
        report = loop.run(seconds, until or (lambda: False))
        if loop.error is not None:
            self.robot.recover()
            time.sleep(1.0)  # for the arm to settle
        return report

    def go_to_start(self) -> deploy.Report:
        """Bring the grip to where the task starts."""
        goal = deploy.ReachTargets(self.deployed, self.deployed.start)
        loop = self._loop(self.robot, goal, self.source())
        return self._run(loop, 8.0, lambda: goal.distance < 0.01)

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
        report = self._run(loop, 15.0, lambda: via.done)
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

    def episode(self, number: int) -> dict:
        """One episode on the server, and the same in our own simulation."""
        points = self.points()
        sphere = self.sphere(points) if number % 2 else None
        found = {"episode": number, "sphere": sphere is not None}
        q = self.deployed.start
        for aborts in range(ATTEMPTS):
            if self.go_to_start().reason is None:
                q, _ = self.robot.look()
                found |= self.fly(self.robot, points, sphere)
                if found["reason"] is None:
                    break
            found["aborts"] = aborts + 1
        stand = stored()["fr3"]
        robot = rmp.Robot.load("fr3", mount=stand.mount, finger=stand.turn)
        model = robot.mj_model
        model.opt.timestep = 0.001
        data = mujoco.MjData(model)
        data.qpos[:] = q
        own = self.fly(MujocoBackend(model, data, 7), points, sphere)
        keep = ("reached", "times", "nearest_cm", "clearance_cm")
        return {"aborts": 0} | found | {"own": {k: own[k] for k in keep}}

    def hold(self) -> dict:
        """Drift of an arm that only holds itself, in three seconds."""
        goal = deploy.ReachTargets(self.deployed, self.robot.look()[0])
        loop = self._loop(self.robot, goal, self.source())
        report, log = loop.run(0.0, hold=3.0), loop.log.columns()
        q = log["q"][log["phase"] == PHASES.index("held")]
        if loop.error is not None:
            self.robot.recover()
        drift = round(1e3 * float(np.max(np.abs(q[-1] - q[0]))), 2) if len(q) else None
        return {"drift_mrad": drift, "reason": report.reason}

    def stale(self) -> dict:
        """The source of obstacles falls silent while the policy moves the arm."""
        policy = deploy.PolicyTargets(self.deployed, deploy.ViaPoints(self.points()))
        loop = self._loop(self.robot, policy, self.source(), stale=0.7)
        report = self._run(loop, 10.0)
        return {"reason": report.reason, "held": report.held}

    def reflex(self) -> dict:
        """Commands stay away; the robot stops itself, and goes on when told to."""
        goal = deploy.ReachTargets(self.deployed, self.deployed.start)

        def sleepy(q, qd, t, seen):
            if t > 0.5:
                time.sleep(0.5)
            return goal(q, qd, t, seen)

        loop = self._loop(self.robot, sleepy, self.source(), late=9.0)
        report = loop.run(5.0)
        self.robot.recover()
        time.sleep(1.0)  # for the arm to settle
        again = self.hold()
        return {"reason": report.reason, "after": again["reason"]}

    def wrong(self) -> dict:
        """A file of another arm is refused."""
        file = self.options.folder / "panda.rmp"
        file.unlink(missing_ok=True)
        export.main([POLICY, "--out", str(file)])
        try:
            FrankaBackend(deploy.load(file), ADDRESS, realtime=False)
        except WrongRobotError as error:
            return {"refused": str(error)}
        return {"refused": None}


def table(rows: list[dict]) -> str:
    """The episodes in Markdown."""
    lines = [
        "| episode | sphere | visited | last point [s] | own simulation [s] "
        "| clearance, own [cm] | torque | rate | tick p50, p99, worst [ms] | anew |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        if "times" not in row:
            lines.append(f"| {row['episode']} | never begun |")
            continue
        p50, p99, _, worst = row["interval_ms"]
        own = row["own"]
        lines.append(
            f"| {row['episode']} | {'yes' if row['sphere'] else 'no'} "
            f"| {row['reached']} of 4 | {(row['times'] or [np.nan])[-1]} "
            f"| {(own['times'] or [np.nan])[-1]} "
            f"| {row['clearance_cm']}, {own['clearance_cm']} "
            f"| {100 * row['torque']:.0f} % | {100 * row['torque_rate']:.0f} % "
            f"| {p50}, {p99}, {worst} | {row['aborts']} |"
        )
    return "\n".join(lines)


def main() -> int:
    """Run everything; 1 if an episode missed a via point or touched something."""
    options = tyro.cli(Options, config=(tyro.conf.OmitArgPrefixes,))
    runtime.configure()
    options.folder.mkdir(parents=True, exist_ok=True)
    demo = Demo(options)
    with serving(options):
        demo.connect()
        found: dict = {"wrong_robot": demo.wrong()}
        demo.go_to_start()
        found["hold"] = demo.hold()
        found["episodes"] = []
        for number in range(options.episodes):
            row = demo.episode(number)
            found["episodes"].append(row)
            print(f"episode {number}: {row.get('reached', 0)} of 4 visited", flush=True)
        found["stale"] = demo.stale()
        found["reflex"] = demo.reflex()
    rows = found["episodes"]
    print(table(rows))
    for name in ("wrong_robot", "hold", "stale", "reflex"):
        print(f"{name}: {found[name]}")
    if options.json:
        command = "python -m benchmarks.deploy_demo " + " ".join(sys.argv[1:])
        about = {"command": command.strip(), "machine": machine()}
        options.json.write_text(json.dumps(about | found, indent=1) + "\n")
    good = [r.get("reached") == 4 and r["clearance_cm"] > 0.0 for r in rows]
    return 1 - all(good)


if __name__ == "__main__":
    sys.exit(main())
