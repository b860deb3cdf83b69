"""The numbers of the default leaves that `benchmarks.tune` searches."""

from __future__ import annotations

import dataclasses

import optuna

import rmp_mjx as rmp
from rmp_mjx.control.stirring import Stirring
from rmp_mjx.control.yielding import Yielding, limit_yielding
from rmp_mjx.rmp.leaves import JointLimitBarrier, Posture
from rmp_mjx.rmp.leaves.collision import collision_near
from rmp_mjx.rmp.leaves.joint_limit import joint_limit_barrier


@dataclasses.dataclass(frozen=True)
class Parameters:
    """What is tuned; the defaults are the leaves' own (a test holds them together)."""

    mu: float = 7e-5
    """Collision: metric scale."""
    eps: float = 0.007
    """Collision: velocity floor."""
    eta: float = 20.0
    """Collision: damping [1/s]."""
    r: float = 0.2
    """Collision: range [m]."""
    margin: float = 0.005
    """Collision: margin [m]."""
    k_out: float = 2.5e3
    """Collision: stiffness inside the margin [1/s^2]."""
    limit_mu: float = 2.5e-3
    """Joint limits: metric scale."""
    limit_margin: float = 0.14
    """Joint limits: margin [rad]."""
    limit_r: float = 0.2
    """Joint limits: range [rad]."""
    limit_eta: float = 40.0
    """Joint limits: damping [1/s]."""
    limit_k_out: float = 2e3
    """Joint limits: stiffness inside the margin [1/s^2]."""
    kq: float = 2.5
    """Posture: stiffness [1/s^2]."""
    posture: float = 0.02
    """Posture: weight."""
    least: float = 1e-3
    """Yielding: weight of the orientation at an obstacle."""
    near: float = 0.015
    """Yielding: clearance up to which it has that weight [m]."""
    far: float = 0.07
    """Yielding: clearance at which it begins [m]."""
    stirring: float = 0.03
    """Stirring: amplitude [m]."""
    limit_least: float = 1e-3
    """Yielding near joint limits: weight of the orientation at a limit."""
    limit_far: float = 1.2
    """Yielding near joint limits: distance at which it begins [rad]."""

    @staticmethod
    def suggest(trial: optuna.Trial) -> Parameters:
        """A point of the search space."""
        return Parameters(
            mu=trial.suggest_float("mu", 1e-6, 1e-3, log=True),
            eps=trial.suggest_float("eps", 1e-3, 0.5, log=True),
            eta=trial.suggest_float("eta", 10.0, 60.0, log=True),
            r=trial.suggest_float("r", 0.05, 0.3),
            margin=trial.suggest_float("margin", 0.002, 0.02),
            k_out=trial.suggest_float("k_out", 100.0, 3e3, log=True),
            limit_mu=trial.suggest_float("limit_mu", 3e-4, 1e-1, log=True),
            limit_margin=trial.suggest_float("limit_margin", 0.105, 0.16),
            limit_r=trial.suggest_float("limit_r", 0.05, 1.0, log=True),
            limit_eta=trial.suggest_float("limit_eta", 10.0, 80.0, log=True),
            limit_k_out=trial.suggest_float("limit_k_out", 100.0, 5e3, log=True),
            kq=trial.suggest_float("kq", 0.3, 10.0, log=True),
            posture=trial.suggest_float("posture", 0.002, 0.05, log=True),
            least=trial.suggest_float("least", 1e-4, 0.1, log=True),
            near=trial.suggest_float("near", 0.005, 0.035),
            far=trial.suggest_float("far", 0.04, 0.2, log=True),
            stirring=trial.suggest_float("stirring", 0.005, 0.05, log=True),
            limit_least=trial.suggest_float("limit_least", 1e-4, 0.1, log=True),
            limit_far=trial.suggest_float("limit_far", 0.3, 2.0, log=True),
        )

    def controller(self, robot: rmp.Robot) -> rmp.RMPVICES:
        """RMP-VICES with these leaves."""
        collision = collision_near().replace(
            mu=self.mu,
            eps=self.eps,
            eta=self.eta,
            r=self.r,
            margin=self.margin,
            k_out=self.k_out,
        )
        barrier = joint_limit_barrier().replace(
            mu=self.limit_mu,
            margin=self.limit_margin,
            r=self.limit_r,
            eta=self.limit_eta,
            k_out=self.limit_k_out,
        )
        return rmp.RMPVICES(
            robot,
            collision=collision,
            self_collision=collision,
            joint_limit=JointLimitBarrier(robot.q_lower, robot.q_upper, barrier),
            posture=Posture(robot.q_home, kq=self.kq, kd=10.0, weight=self.posture),
            yielding=Yielding(least=self.least, near=self.near, far=self.far),
            stirring=Stirring(amplitude=self.stirring),
            limit_yielding=limit_yielding().replace(
                least=self.limit_least, far=self.limit_far
            ),
        )
