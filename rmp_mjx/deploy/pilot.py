"""One tick after the other: state in, torque out, and when to stop.

The phases are `start`, in which the torque goes over from holding the arm to the
controller's; `run`; `stop`, the way back; `brake`, after a fault; and `held`, at rest.
There is always a torque that carries the arm: it is never let fall.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rmp_mjx.deploy.deployed import Deployed
from rmp_mjx.deploy.sources import ObstacleSource
from rmp_mjx.deploy.targets import Targets
from rmp_mjx.deploy.watchdog import Watchdog

PHASES = ("start", "run", "stop", "brake", "held")
"""The phases, in the order of their numbers in a log."""
RAMP = 0.5
"""Time in which the torque goes over to the controller's, and back [s]."""
AT_REST = 0.02
"""Speed below which an arm that brakes counts as at rest [rad/s]."""
BRAKING = 1.0
"""Time after which it is held in its place all the same [s]."""
HOLD = 25.0
"""Stiffness that holds an arm at rest in its place [1/s^2]."""
RATE = 0.9
"""Share of the torque rate's limit that is sent, if not else said."""


class Pilot:
    """Decides on the torque of each tick; knows neither clock nor robot."""

    def __init__(
        self,
        deployed: Deployed,
        obstacles: ObstacleSource,
        targets: Targets,
        watchdog: Watchdog | None = None,
        rate: float = RATE,
    ):
        """Compile the controller.

        Args:
            deployed: The file.
            obstacles: Where the obstacles come from.
            targets: Where the set-points come from.
            watchdog: Bounds; default the usual ones.
            rate: Share of the torque rate's limit that is sent.
        """
        self.deployed, self.limits = deployed, deployed.limits
        self.obstacles, self.targets = obstacles, targets
        self.watchdog = watchdog or Watchdog()
        self._control = deployed.flat("control")
        self.phase, self.reason = "start", None
        self.ticks, self.time, self._since, self._due = 0, 0.0, 0.0, 0.0
        self.tau = np.zeros(deployed.n)
        self.gravity = np.zeros(deployed.n)
        self.out: dict[str, Any] = {}
        self.age = 0.0
        self._number, self._rate = -1, rate
        self._q = self._qd = self._q_held = np.zeros(deployed.n)

    @property
    def compilations(self) -> int:
        """How often the controller was compiled."""
        return self._control.compilations

    def stop(self) -> None:
        """Give the torque back to holding the arm, and hold it."""
        if self.phase in ("start", "run"):
            self._enter("stop")

    def fault(self, reason: str) -> None:
        """Brake, and hold the arm; the first reason counts."""
        self.reason = self.reason or reason
        if self.phase not in ("brake", "held"):
            self._enter("brake")

    def _enter(self, phase: str) -> None:
        self.phase, self._since = phase, 0.0

    def step(self, q: np.ndarray, qd: np.ndarray, dt: float) -> np.ndarray:
        """The torque of one tick, (n,) [N m], gravity included.

        Args:
            q: Joint positions, (n,) [rad].
            qd: Joint velocities, (n,) [rad/s].
            dt: Time since the last tick [s].
        """
        q, qd = np.asarray(q, float), np.asarray(qd, float)
        first = self.ticks == 0
        self.time += 0.0 if first else dt
        before = q if first else self._q
        blind = self.watchdog.unreadable(self.limits, q, qd, before, dt)
        wrong = blind or self.watchdog.of_state(self.limits, q, qd)
        if first and wrong:
            raise ValueError(f"no start from this state: {wrong}")
        seen = self.obstacles.get()
        self.age = self.obstacles.clock() - seen.stamp
        late = self.watchdog.of_time(dt, self.deployed.period, self.age)
        for reason in (late, wrong):
            if reason:
                self.fault(reason)
        if blind:
            q, qd = self._predicted()
        if first:
            self._begin(q, seen)
        self._think(q, qd, seen)
        self._control.put(0, q)
        self._control.put(1, qd)
        self.out = out = self._control()
        self.gravity = out["gravity"].astype(float)
        asked = out["tau"].astype(float)
        wrong = self.watchdog.of_torque(
            self.limits, asked, self.tau, self.deployed.period
        )
        if not out["usable"] > 0:
            wrong = "the controller cannot use its inputs"
        if wrong:
            self.fault(wrong)
        tau = self._sent(self._mixed(q, qd, asked))
        memory = out["memory"] | {"tau": tau}
        self._control.put(4, memory)
        self._q, self._qd = q, qd
        self.ticks += 1
        self._since += self.deployed.period
        return tau

    def _predicted(self) -> tuple[np.ndarray, np.ndarray]:
        """The state that the model expects after the last tick.

        An arm whose state cannot be read any more is brought to rest with it.
        """
        memory, dt = self.out["memory"], self.deployed.period
        bias = memory["bias"].astype(float)
        qdd = np.linalg.solve(memory["Mq"].astype(float), self.tau - bias)
        qd = self._qd + dt * qdd
        return self._q + dt * qd, qd

    def _begin(self, q: np.ndarray, seen: Any) -> None:
        """Take over an arm that stands still: the last torque held it."""
        zero = np.zeros_like(q)
        self._control.put(0, q)
        self._control.put(1, zero)
        self._control.put(2, self.targets(q, zero, 0.0, seen))
        self._see(seen)
        memory = self.deployed.memory()
        self._control.put(4, memory)
        self.tau = self._control()["gravity"].astype(float)
        self._control.put(4, memory | {"tau": self.tau.astype(np.float32)})

    def _see(self, seen: Any) -> None:
        if seen.number != self._number:
            self._control.put(3, seen.slots)
            self._number = seen.number

    def _think(self, q: np.ndarray, qd: np.ndarray, seen: Any) -> None:
        """Take in new obstacles, and at a policy step a new set-point."""
        self._see(seen)
        moving = self.phase in ("start", "run", "stop")
        if moving and self.time > self._due - 0.5 * self.deployed.period:
            self._due = self.time + self.deployed.policy_period
            try:
                self._control.put(2, self.targets(q, qd, self.time, seen))
            except Exception as error:  # whoever gives the targets, the arm must stop
                self.fault(f"no set-point: {error!r}")

    def _mixed(self, q: np.ndarray, qd: np.ndarray, asked: np.ndarray) -> np.ndarray:
        """The torque of the phase, before limits."""
        brake = self.out["brake"].astype(float)
        share = min(self._since / RAMP, 1.0)
        slow = np.max(np.abs(qd)) < AT_REST
        if self.phase == "start" and share >= 1.0:
            self._enter("run")
        if self.phase == "stop" and share >= 1.0:
            self._enter("brake")
        if self.phase == "brake" and (slow or self._since > BRAKING):
            self._enter("held")
            self._q_held = q
        if self.phase == "run":
            return asked
        if self.phase == "start":
            return brake + share * (asked - brake)
        if self.phase == "stop":
            return asked + share * (brake - asked)
        if self.phase == "held":
            pull = np.clip(self._q_held - q, -0.1, 0.1)
            return brake + HOLD * (self.out["memory"]["Mq"].astype(float) @ pull)
        return brake

    def _sent(self, tau: np.ndarray) -> np.ndarray:
        """The torque within the arm's limits and their rate, and remember it."""
        step = self._rate * self.limits.tau_rate * self.deployed.period
        tau = np.clip(tau, self.tau - step, self.tau + step)
        self.tau = np.clip(tau, -self.limits.tau, self.limits.tau)
        return self.tau
