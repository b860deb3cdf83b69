"""What makes a loop stop the arm."""

from __future__ import annotations

import dataclasses

import numpy as np

from rmp_mjx.deploy.deployed import Limits


@dataclasses.dataclass(frozen=True)
class Watchdog:
    """The bounds; beyond one of them the arm is stopped."""

    late: float = 0.01
    """A tick may come so much after the one before, beyond the period [s]."""
    stale: float | None = 0.25
    """Obstacles may be so old [s]; None: they are the world's own and never change."""
    overspeed: float = 1.1
    """A joint may be so many times as fast as its limit."""
    outside: float = 0.02
    """A joint may be so far beyond the end of its range [rad]."""
    jump: float = 0.05
    """A joint may move so far in a tick beyond what its speed explains [rad]."""
    over: float = 1.01
    """The controller may ask for so many times the limit of torque or torque rate."""

    def unreadable(
        self,
        limits: Limits,
        q: np.ndarray,
        qd: np.ndarray,
        q_last: np.ndarray,
        dt: float,
    ) -> str | None:
        """Why a measured state cannot be believed; None: it can.

        Args:
            limits: Of the arm.
            q: Joint positions, (n,) [rad].
            qd: Joint velocities, (n,) [rad/s].
            q_last: Positions at the last tick, (n,) [rad].
            dt: Time since then [s].
        """
        if q.shape != limits.tau.shape or qd.shape != limits.tau.shape:
            return f"state of shape {q.shape}, not of {limits.tau.shape}"
        if not (np.all(np.isfinite(q)) and np.all(np.isfinite(qd))):
            return "state not finite"
        leap = np.abs(q - q_last) > self.jump + 2.0 * np.abs(qd) * dt
        return f"joint {np.argmax(leap)} jumped" if leap.any() else None

    def of_state(self, limits: Limits, q: np.ndarray, qd: np.ndarray) -> str | None:
        """What is wrong with a state that can be believed; None: nothing.

        Args:
            limits: Of the arm.
            q: Joint positions, (n,) [rad].
            qd: Joint velocities, (n,) [rad/s].
        """
        fast = np.abs(qd) > self.overspeed * limits.qd
        if fast.any():
            return f"joint {np.argmax(fast)} too fast: {qd[np.argmax(fast)]:.2f} rad/s"
        out = (q < limits.q_lower - self.outside) | (q > limits.q_upper + self.outside)
        if out.any():
            return f"joint {np.argmax(out)} outside its range: {q[np.argmax(out)]:.2f}"
        return None

    def of_torque(
        self, limits: Limits, tau: np.ndarray, tau_last: np.ndarray, period: float
    ) -> str | None:
        """What is wrong with a torque that the controller asks for; None: nothing.

        Args:
            limits: Of the arm.
            tau: Torque, (n,) [N m].
            tau_last: Torque that was sent last, (n,) [N m].
            period: Time between the two [s].
        """
        if not np.all(np.isfinite(tau)):
            return "torque not finite"
        if np.any(np.abs(tau) > self.over * limits.tau):
            return "torque beyond its limit"
        if np.any(np.abs(tau - tau_last) > self.over * limits.tau_rate * period + 1e-3):
            return "torque rate beyond its limit"
        return None

    def of_time(self, dt: float, period: float, age: float) -> str | None:
        """What is wrong with the clock or the obstacles' age [s]; None: nothing."""
        if dt > period + self.late:
            return f"tick late by {1e3 * (dt - period):.1f} ms"
        if self.stale is not None and age > self.stale:
            return f"obstacles stale: {1e3 * age:.0f} ms old"
        return None
