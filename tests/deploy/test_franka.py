"""The FR3 behind Franka's bindings: with a stand-in for them, and with a server."""

import json
import os
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from rmp_mjx import deploy
from rmp_mjx.deploy import franka
from rmp_mjx.deploy.franka import FrankaBackend, WrongRobotError
from rmp_mjx.robot import Robot


class Torques:
    def __init__(self, tau):
        self.tau, self.motion_finished = tau, False


class Bindings:
    """A robot in MuJoCo that carries its own weight, with the bindings' interface."""

    RealtimeConfig = SimpleNamespace(kEnforce="enforce", kIgnore="ignore")
    Torques = Torques

    def __init__(self, simulated, axis_error=0.0):
        self.simulated, self.axis_error = simulated, axis_error
        self.sent, self.calls, self.aborted = [], [], False
        self.reads, self.waits = 0, []
        arm = Robot.load("fr3")
        self.flange = arm.mj_model.site("ee").id
        self.arm = arm.mj_model

    def Robot(self, address, config):
        self.calls.append((address, config))
        return self

    def read_once(self):
        import mujoco

        q, qd = self.simulated.read()
        data = mujoco.MjData(self.arm)
        data.qpos[:] = q
        mujoco.mj_forward(self.arm, data)
        T = np.eye(4)
        T[:3, :3] = data.site_xmat[self.flange].reshape(3, 3)
        T[:3, 3] = data.site_xpos[self.flange] + self.axis_error
        return SimpleNamespace(q=list(q), dq=list(qd), O_T_EE=list(T.T.ravel()))

    def set_collision_behavior(self, *thresholds):
        self.calls.append("thresholds")

    def start_torque_control(self):
        self.calls.append("start")
        return self

    def readOnce(self):
        self.reads += 1
        if self.aborted:
            raise RuntimeError("reflex")
        time.sleep(self.waits.pop() if self.waits else 0.0)
        q, qd = self.simulated.read()
        return SimpleNamespace(q=list(q), dq=list(qd)), 0.001

    def writeOnce(self, torques):
        import mujoco

        self.sent.append(torques)
        simulated = self.simulated
        held = mujoco.MjData(simulated.model)
        held.qpos[:] = simulated.data.qpos
        mujoco.mj_forward(simulated.model, held)
        simulated.write(np.array(torques.tau) + held.qfrc_bias)

    def automatic_error_recovery(self):
        self.aborted = False


@pytest.fixture
def bindings(simulated, monkeypatch):
    found = Bindings(simulated)
    monkeypatch.setitem(sys.modules, "pylibfranka", found)
    return found


@pytest.fixture
def loop(deployed, bindings):
    backend = FrankaBackend(deployed, "172.16.0.2")
    goal = deploy.ReachTargets(deployed, deployed.start)
    # The stand-in does not keep time.
    watchdog = deploy.Watchdog(stale=None, late=60.0)
    return deploy.Loop(deployed, backend, goal, watchdog=watchdog)


def test_a_franka_gets_no_gravity_and_stays_where_it_is(loop, bindings):
    before, _ = bindings.simulated.read()
    report = loop.run(0.5, hold=0.2)
    assert report.reason is None and report.held
    assert bindings.calls == [("172.16.0.2", "enforce"), "thresholds", "start"]
    sent = np.array([torques.tau for torques in bindings.sent])
    assert np.max(np.abs(sent)) < 1.0  # gravity alone would be 30 N m
    assert [t.motion_finished for t in bindings.sent[-2:]] == [False, True]
    np.testing.assert_allclose(bindings.simulated.read()[0], before, atol=2e-3)


def test_a_reflex_ends_the_loop_and_is_recovered_from(loop, bindings, deployed):
    bindings.aborted = True
    report = loop.run(1.0)
    assert report.reason == "the robot: reflex"
    loop.backend.recover()
    again = deploy.Loop(
        deployed, loop.backend, loop.pilot.targets, watchdog=loop.pilot.watchdog
    )
    assert again.run(0.1, hold=0.0).reason is None


def test_a_state_that_has_waited_is_let_go(deployed, bindings, monkeypatch):
    """The answer to it would come too late; one that had to be waited for is new.

    10 ms and not 0.05: a test's machine is slow.
    """
    monkeypatch.setattr(franka, "AT_ONCE", 0.01)
    backend = FrankaBackend(deployed, "x")
    bindings.waits = [0.02]
    backend.read()
    assert bindings.reads == 1
    backend.read()
    assert bindings.reads == 3


def test_ahead_a_torque_answers_the_next_state(deployed, bindings):
    backend = FrankaBackend(deployed, "x", ahead=True)
    for k in range(3):
        assert len(bindings.sent) == max(k - 1, 0)
        backend.read()
        backend.write(np.full(7, float(k)))
    backend.finish(np.full(7, 9.0))
    assert [torques.tau[0] for torques in bindings.sent] == [0.0, 1.0, 9.0]
    assert [torques.motion_finished for torques in bindings.sent] == [
        False,
        False,
        True,
    ]


def test_a_robot_whose_tool_is_elsewhere_is_refused(deployed, bindings):
    bindings.axis_error = np.array([0.0, 0.03, 0.0])
    with pytest.raises(WrongRobotError, match=r"3\.0 cm from it"):
        FrankaBackend(deployed, "x")


@pytest.mark.parametrize(
    ("robot", "message"), [("panda", "reach the FR3 alone"), ("ur5e", "6 joints")]
)
def test_a_file_of_another_arm_is_refused_before_anything_connects(
    deployed, bindings, robot, message
):
    joints = [f"joint{k}" for k in range(6 if robot == "ur5e" else 7)]
    other = SimpleNamespace(metadata={"robot": {"name": robot, "joints": joints}})
    with pytest.raises(WrongRobotError, match=message):
        FrankaBackend(other, "x")  # pyright: ignore[reportArgumentType]
    assert not bindings.calls


def test_missing_bindings_are_named(deployed, monkeypatch):
    monkeypatch.setitem(sys.modules, "pylibfranka", None)
    with pytest.raises(ImportError, match=r"pip install 'rmp-mjx\[franka\]'"):
        FrankaBackend(deployed, "x")


def _only_late(found):
    """Whether every show that failed did so by ticks of this machine that were late."""
    shows = [*found["episodes"], *(found[x] for x in ("hold", "stale", "reflex"))]
    late = "tick late", "communication_constraints_violation"
    causes = [why for x in shows if not x["passed"] for why in x["aborts"]]
    return bool(causes) and all(why.startswith(late) for why in causes)


@pytest.mark.slow
def test_the_policy_works_against_a_server_of_the_robots_protocol(root, tmp_path):
    """One episode with a sphere and one without; the rest of the demo besides.

    It takes a minute, and both cores of a small machine. One that does not get to its
    ticks in time, five times over, cannot tell.
    """
    server, bindings = root / "build/franka-sim", root / "build/pylibfranka"
    if not (server.exists() and bindings.exists()):
        pytest.skip("server and bindings are not installed: make deploy-demo does it")
    rows = tmp_path / "rows.json"
    command = ["-m", "benchmarks.deploy_demo", "--episodes", "2"]
    command += ["--folder", str(tmp_path / "demo"), "--json", str(rows)]
    done = subprocess.run(
        [sys.executable, *command],
        cwd=root,
        env={**os.environ, "PYTHONPATH": f"{root}:{bindings}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert rows.exists(), done.stdout + done.stderr
    found = json.loads(rows.read_text())
    if done.returncode and _only_late(found):
        pytest.skip(f"this machine is too busy for 1 kHz: {found['aborts']}")
    assert done.returncode == 0, done.stdout + done.stderr
    assert [row["reached"] for row in found["episodes"]] == [4, 4]
    assert [row["sphere"] for row in found["episodes"]] == [False, True]
    assert all(row["clearance_cm"] > 0.0 for row in found["episodes"])
    # 0.45 of the limit is sent, so that two torques in one tick keep it; rounding.
    assert all(row["torque_rate"] <= 0.451 for row in found["episodes"])
    assert found["hold"]["drift_mrad"] < 5.0
    assert found["stale"]["held"] and found["stale"]["reason"].startswith("obstacles")
    assert "reflex" in found["reflex"]["provoked"]
    assert found["reflex"]["reason"] is None
    assert "panda" in found["wrong_robot"]["refused"]
