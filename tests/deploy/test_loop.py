"""The loop: what it does with an arm, and what makes it stop."""

import copy
import threading
import time
from typing import Any

import jax
import mujoco
import numpy as np
import polars as pl
import pytest

from rmp_mjx import deploy
from rmp_mjx.deploy.log import RingLog
from rmp_mjx.deploy.pilot import PHASES, Pilot
from rmp_mjx.sim.robot import MujocoBackend

POINTS = [[0.35, -0.1, 0.1], [0.5, 0.1, 0.2], [0.35, 0.15, 0.1], [0.45, -0.15, 0.25]]
NEVER = deploy.Watchdog(stale=None)


@pytest.fixture
def make(deployed, simulated, source):
    """`make(targets, ...)`: a loop over the simulated arm."""

    def build(targets=None, watchdog=NEVER, backend=simulated, **options):
        targets = targets or deploy.ReachTargets(deployed, deployed.start)
        return deploy.Loop(
            deployed, backend, targets, source.source, watchdog, **options
        )

    return build


def test_the_policy_visits_its_via_points_within_the_limits(
    make, deployed, simulated, tmp_path
):
    via = deploy.ViaPoints(np.array(POINTS))
    loop = make(deploy.PolicyTargets(deployed, via), log=tmp_path / "log.parquet")
    report = loop.run(10.0, until=lambda: via.done)
    assert via.reached == 4 and np.all(via.nearest < 0.05)
    assert report.reason is None and report.held
    assert report.torque <= 1.0
    assert report.torque_rate <= 0.9 + 1e-9  # the share that is sent; rounding
    assert report.speed < 1.0
    assert report.clearance > 0.05
    assert loop.pilot.compilations == 1  # nothing was compiled on the way
    log = pl.read_parquet(tmp_path / "log.parquet")
    assert len(log) == report.ticks
    assert {"q0", "qd6", "tau3", "tau_ext0", "time", "clearance"} <= set(log.columns)
    assert set(log["phase"]) == {0.0, 1.0, 2.0, 3.0, 4.0}
    assert np.max(np.abs(simulated.read()[1])) < 0.02  # at rest in the end [rad/s]


def test_the_torque_starts_and_ends_where_gravity_is(make, simulated, trained):
    """Bumpless: the first torque is what holds the arm, to one step of the rate."""
    loop = make()
    q, _ = simulated.read()
    hold = simulated.data.qfrc_bias.copy()
    simulated.write(np.zeros(7))  # mj_step fills in qfrc_bias
    hold = simulated.data.qfrc_bias.copy()
    simulated.data.qpos[:], simulated.data.qvel[:] = q, 0.0
    loop.run(1.0)
    tau = loop.log.columns()["tau"]
    np.testing.assert_allclose(tau[0], hold, atol=0.91)  # 0.9 N m: a step of the rate
    simulated.write(tau[-1])
    np.testing.assert_allclose(tau[-1], simulated.data.qfrc_bias, atol=0.05)


def test_an_arm_at_rest_stays_where_it_is(make, simulated):
    before, _ = simulated.read()
    make().run(2.0)
    np.testing.assert_allclose(simulated.read()[0], before, atol=2e-3)  # [rad]


class Faulty:
    """A simulated arm whose state is spoilt from a tick on, for some ticks."""

    pace, carries_weight = "simulation", False

    def __init__(self, backend, spoil, begin=1000, ticks=10**9):
        self.backend, self.spoil = backend, spoil
        self.begin, self.end, self.count = begin, begin + ticks, 0
        self.speeds = []

    def read(self):
        q, qd = self.backend.read()
        self.speeds.append(np.max(np.abs(qd)))
        self.count += 1
        return self.spoil(q, qd) if self.begin <= self.count < self.end else (q, qd)

    def write(self, tau):
        assert np.all(np.isfinite(tau))
        assert np.max(np.abs(tau[[1, 3]])) > 5.0  # what carries the arm is still there
        self.backend.write(tau)

    finish = write


FAULTS = {
    "nan": (lambda q, qd: (q * np.nan, qd), "state not finite"),
    "infinite": (lambda q, qd: (q, qd + np.inf), "state not finite"),
    "jump": (lambda q, qd: (q + 0.4, qd), "joint 0 jumped"),
    "fast": (lambda q, qd: (q, qd + np.eye(7)[2] * 9), "joint 2 too fast: 9"),
    "short": (lambda q, qd: (q[:6], qd[:6]), "state of shape"),
}


@pytest.mark.parametrize(
    ("fault", "ticks"),
    [
        *((name, 1) for name in FAULTS),
        *((name, 10**9) for name in ("nan", "jump", "short")),
    ],
)
def test_a_state_that_cannot_be_stops_the_arm(make, deployed, simulated, fault, ticks):
    """In the middle of a motion, for a tick or for good."""
    spoil, reason = FAULTS[fault]
    via = deploy.ViaPoints(np.array(POINTS))
    faulty = Faulty(simulated, spoil, ticks=ticks)
    loop = make(deploy.PolicyTargets(deployed, via), backend=faulty)
    report = loop.run(10.0)
    assert report.reason is not None and report.reason.startswith(reason)
    assert report.held
    assert faulty.speeds[995] > 0.1  # it was moving [rad/s]
    # 1 s after the fault, ten time constants of the braking. What is left of an arm
    # that is braked blindly is the model's error, here that of its integration.
    assert faulty.speeds[-1] < (0.02 if ticks == 1 else 0.1)
    assert len(faulty.speeds) < 3000


def test_stale_obstacles_stop_the_arm(make, source, deployed):
    via = deploy.ViaPoints(np.array(POINTS))
    loop = make(deploy.PolicyTargets(deployed, via), deploy.Watchdog(stale=0.2))
    pilot = loop.pilot

    def turn_clock():
        source.clock.now = pilot.ticks * 0.001
        if source.clock.now < 0.7:
            source.source.fresh()
        return False

    report = loop.run(10.0, until=turn_clock)
    assert report.reason is not None and report.reason.startswith("obstacles stale")
    phase = loop.log.columns()["phase"]
    first = int(np.argmax(phase == PHASES.index("brake")))
    assert 0.9 <= first * 0.001 <= 0.91  # 0.2 s after the last news
    assert report.held


def test_a_late_tick_stops_the_arm(deployed, source):
    pilot = Pilot(
        deployed, source.source, deploy.ReachTargets(deployed, deployed.start), NEVER
    )
    q, qd = deployed.start, np.zeros(7)
    for _ in range(600):
        pilot.step(q, qd, 0.001)
    assert pilot.phase == "run"
    pilot.step(q, qd, 0.012)
    assert pilot.reason == "tick late by 11.0 ms"
    assert pilot.phase == "held"  # it was at rest


def test_no_set_point_stops_the_arm(make):
    calls = []

    def targets(q, qd, time, seen):
        calls.append(time)
        if time > 0.21:
            raise RuntimeError("the planner died")
        return deploy_targets(q, qd, time, seen)

    loop = make()
    deploy_targets = loop.pilot.targets
    loop.pilot.targets = targets
    report = loop.run(5.0)
    assert report.reason == "no set-point: RuntimeError('the planner died')"
    assert report.held and len(calls) == 7  # one to begin with, six at 20 Hz


def test_a_torque_beyond_the_limits_is_a_fault(deployed):
    limits, dog = deployed.limits, deploy.Watchdog()
    zero = np.zeros(7)
    assert dog.of_torque(limits, zero + 0.9, zero, 0.001) is None
    too_much = limits.tau * 1.02
    assert dog.of_torque(limits, too_much, too_much, 0.001) == "torque beyond its limit"
    assert dog.of_torque(limits, zero + 1.1, zero, 0.001) == (
        "torque rate beyond its limit"
    )
    assert dog.of_torque(limits, zero * np.nan, zero, 0.001) == "torque not finite"


def test_an_arm_is_not_started_from_an_impossible_state(make, simulated):
    simulated.data.qpos[3] = 1.0  # its range ends at -0.15 rad
    with pytest.raises(ValueError, match="no start from this state: joint 3 outside"):
        make().run(1.0)


def test_a_robot_that_does_not_answer_ends_the_loop(make, simulated):
    def read():
        if simulated.data.time > 0.1:
            raise ConnectionError("reflex")
        return simulated.read()

    backend = deploy.CallbackBackend(read, simulated.write, pace="simulation")
    loop = make(backend=backend)
    report = loop.run(5.0)
    assert report.reason == "the robot: reflex" and not report.held
    assert isinstance(loop.error, ConnectionError)


def test_a_loop_keeps_its_own_time_and_stops_from_another_thread(make, simulated):
    """Wall clock: 0.3 s and the stop, on a machine that others use too."""
    backend = deploy.CallbackBackend(simulated.read, simulated.write)
    loop = make(backend=backend, watchdog=deploy.Watchdog(stale=None, late=10.0))
    timer = threading.Timer(0.3, loop.stop)
    timer.start()
    begin = time.perf_counter()
    report = loop.run(hold=0.05)
    passed = time.perf_counter() - begin
    assert report.reason is None and report.held
    assert 0.3 + 0.5 < passed < 10.0  # the ramp back takes 0.5 s
    assert report.interval.p50 > 5e-4  # never two ticks at once


def test_a_sphere_in_the_way_is_avoided(make, deployed, simulated, source, trained):
    """The sphere is put while the loop runs, between the grip and its goal."""
    q = deployed.start.copy()
    q[0] += 0.7
    goal = deploy.ReachTargets(deployed, q)
    loop = make(goal)
    here = np.asarray(deployed.grip(deployed.start[None], np.zeros((1, 7)))["p"])[0]
    center = 0.5 * (here + goal.goal["p"])
    source.source.put("spheres", center=[center], radius=[0.05])
    report = loop.run(4.0)
    assert report.reason is None
    assert 0.0 < report.clearance < 0.05
    assert goal.distance < 0.01  # it goes round


def test_any_thread_may_put_obstacles(deployed):
    source = deploy.ObstacleSource(deployed.obstacles())
    before = source.get()
    source.put("spheres", center=[[1.0, 2.0, 3.0]], radius=[0.1], stamp=5.0)
    after = source.get()
    assert (after.number, after.stamp) == (before.number + 1, 5.0)
    assert after.slots["spheres"]["active"].tolist() == [True, False, False, False]
    assert not before.slots["spheres"]["active"].any()  # what was read stays
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"center": np.zeros((5, 3)), "radius": np.ones(5)}, "at most 4"),
        ({"center": np.zeros((2, 3)), "radius": np.ones(1)}, "at most 4"),
        ({"center": [[np.nan, 0, 0]], "radius": [1.0]}, "must be finite"),
        ({"centre": [[0, 0, 0]]}, "no centre, only"),
    ]
    for fields, message in wrong:
        with pytest.raises(ValueError, match=message):
            source.put("spheres", **fields)
    with pytest.raises(ValueError, match="no slots for boxes"):
        source.put("boxes", center=[[0, 0, 0]])


def test_a_log_keeps_the_last_ticks():
    log = RingLog(2, 3)
    for k in range(5):
        log.add(time=k, q=[k, -k])
    assert log.columns()["time"].tolist() == [2, 3, 4]
    assert log.columns()["q"].tolist() == [[2, -2], [3, -3], [4, -4]]


def test_the_observer_feels_a_push(make, simulated):
    """5 N m on joint 2 for good: the estimate, a low-pass of 10 ms, gets there.

    0.05 N m: float32, and what an arm that gives way turns in a step.
    """
    loop = make(backend=simulated)
    simulated.data.qfrc_applied[1] = 5.0
    loop.run(1.5)
    felt = loop.log.columns()["tau_ext"]
    wanted = np.where(np.arange(7) == 1, 5.0, 0.0)
    np.testing.assert_allclose(felt[1000], wanted, atol=0.05)


def test_the_observer_feels_what_the_table_gives_a_hand_that_presses(deployed, trained):
    """Against MuJoCo's own contact forces, J^T f, in every tick of a press.

    The loop is not told of the table. Its estimate is the low-pass of these torques, K
    = 100 / s, one tick late: 1e-3 N m, where float32 has 1e-5 of 90 N m. So it is late
    by h / (1 - exp(-K h)) = 10.5 ms: 0.1 ms for what is left of the bouncing at the
    end. At the end the hand still creeps: 0.02 N m, by a torque of 1 N m/s so late.
    """
    model = copy.copy(trained.env.scene.model)
    model.opt.timestep = 0.001
    data = mujoco.MjData(model)
    data.qpos[:] = trained.env.robot.q_home
    arm, forces = MujocoBackend(model, data, 7), []

    def write(tau):
        arm.write(tau)
        forces.append(data.qfrc_constraint.copy())

    backend = deploy.CallbackBackend(arm.read, write, pace="simulation")
    down = deploy.ReachTargets(deployed, deployed.start, stiffness=400.0)
    down.goal["p"][2] = -0.17  # the table's top is at -0.112 m
    loop = deploy.Loop(deployed, backend, down, watchdog=NEVER)
    assert loop.run(1.8).reason is None
    felt, acted = loop.log.columns()["tau_ext"][:1800], np.array(forces)[:1800]
    assert np.max(np.abs(acted)) > 20.0  # it does press [N m]
    share, low = -np.expm1(-100.0 * 0.001), np.zeros_like(acted)
    for k in range(1, len(acted)):
        low[k] = low[k - 1] + share * (acted[k - 1] - low[k - 1])
    np.testing.assert_allclose(felt, low, atol=1e-3)
    delay = 0.001 * np.sum(acted - felt, axis=0)[1] / acted[-1, 1]
    assert abs(delay - 0.0105) < 1e-4
    np.testing.assert_allclose(felt[-1], acted[-1], atol=0.02)


def test_what_is_felt_reaches_the_controller(deployed):
    """A contact that presses the hand changes the torque of the contact-aware leaves.

    The observer's low-pass keeps 90 % of what is remembered over a tick of 1 ms.
    """
    q = deployed.start[None].astype(np.float32)
    batch = jax.tree.map(lambda x: x[None].copy(), deployed.memory())
    target = deployed.setpoint(q, np.zeros((1, 12)), np.zeros(1))
    none = jax.tree.map(lambda x: x[None], deployed.obstacles())
    first = deployed.control(q, 0 * q, target, none, batch)
    memory = jax.tree.map(np.asarray, first["memory"])
    calm = deployed.control(q, 0 * q, target, none, memory)
    pressed = memory | {"tau_ext": memory["tau_ext"] + 20.0 * np.eye(7)[None, 1]}
    pushed = deployed.control(q, 0 * q, target, none, pressed)
    change = np.asarray(pushed["tau_ext"] - calm["tau_ext"])[0]
    np.testing.assert_allclose(change, 18.1 * np.eye(7)[1], atol=0.01)
    assert np.max(np.abs(np.asarray(pushed["tau"] - calm["tau"]))) > 0.1  # [N m]


def test_a_layout_of_other_parts_is_refused(deployed):
    flat = deployed.flat("grip")
    with pytest.raises(ValueError, match="expected shape"):
        flat.put(0, np.zeros(6))
    memory = jax.tree.map(np.copy, deployed.memory())
    memory.pop("tau")
    with pytest.raises(ValueError, match="expected PyTreeDef"):
        deployed.flat("control").put(4, memory)
