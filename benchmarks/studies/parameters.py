"""The numbers of the default leaves that `benchmarks.tune` searches."""

from __future__ import annotations

import dataclasses

import numpy as np
import optuna

import rmp_mjx as rmp
from rmp_mjx.control.relaxation import joint_limit_relaxation
from rmp_mjx.rmp.leaves import (
    JointLimitBarrier,
    collision_near,
    joint_limit_barrier,
    soft_posture,
)

COLLISION, LIMIT, POSTURE = (
    collision_near(),
    joint_limit_barrier(),
    soft_posture(np.zeros(0)),
)
RELAXATION, LIMIT_RELAXATION = rmp.OrientationRelaxation(), joint_limit_relaxation()


@dataclasses.dataclass(frozen=True)
class Parameters:
    """What is tuned; the defaults are those of the leaves."""

    mu: float = COLLISION.mu
    """Collision: metric scale."""
    eps: float = COLLISION.eps
    """Collision: velocity floor."""
    eta: float = COLLISION.eta
    """Collision: damping [1/s]."""
    r: float = COLLISION.r
    """Collision: range [m]."""
    margin: float = COLLISION.margin
    """Collision: margin [m]."""
    k_out: float = COLLISION.k_out
    """Collision: stiffness inside the margin [1/s^2]."""
    limit_mu: float = LIMIT.mu
    """Joint limits: metric scale."""
    limit_margin: float = LIMIT.margin
    """Joint limits: margin [rad]."""
    limit_r: float = LIMIT.r
    """Joint limits: range [rad]."""
    limit_eta: float = LIMIT.eta
    """Joint limits: damping [1/s]."""
    limit_k_out: float = LIMIT.k_out
    """Joint limits: stiffness inside the margin [1/s^2]."""
    kq: float = POSTURE.kq
    """Posture: stiffness [1/s^2]."""
    posture: float = POSTURE.weight
    """Posture: weight."""
    min_weight: float = RELAXATION.min_weight
    """Relaxation near obstacles: least weight of the orientation."""
    near: float = RELAXATION.near
    """Relaxation near obstacles: clearance up to which it has that weight [m]."""
    far: float = RELAXATION.far
    """Relaxation near obstacles: clearance at which it begins [m]."""
    dither: float = rmp.SetpointDither().amplitude
    """Dither of the set-point: amplitude [m]."""
    limit_min_weight: float = LIMIT_RELAXATION.min_weight
    """Relaxation near joint limits: least weight of the orientation."""
    limit_far: float = LIMIT_RELAXATION.far
    """Relaxation near joint limits: distance at which it begins [rad]."""

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
            min_weight=trial.suggest_float("min_weight", 1e-4, 0.1, log=True),
            near=trial.suggest_float("near", 0.005, 0.035),
            far=trial.suggest_float("far", 0.04, 0.2, log=True),
            dither=trial.suggest_float("dither", 0.005, 0.05, log=True),
            limit_min_weight=trial.suggest_float(
                "limit_min_weight", 1e-4, 0.1, log=True
            ),
            limit_far=trial.suggest_float("limit_far", 0.3, 2.0, log=True),
        )

    def controller(self, robot: rmp.Robot) -> rmp.RMPVICES:
        """RMP-VICES with these leaves."""
        collision = COLLISION.replace(
            mu=self.mu,
            eps=self.eps,
            eta=self.eta,
            r=self.r,
            margin=self.margin,
            k_out=self.k_out,
        )
        barrier = LIMIT.replace(
            mu=self.limit_mu,
            margin=self.limit_margin,
            r=self.limit_r,
            eta=self.limit_eta,
            k_out=self.limit_k_out,
        )
        leaves = rmp.Leaves(
            collision=collision,
            self_collision=collision,
            joint_limit=JointLimitBarrier(robot.q_lower, robot.q_upper, barrier),
            posture=soft_posture(robot.q_home).replace(kq=self.kq, weight=self.posture),
        )
        return rmp.RMPVICES(
            robot,
            leaves,
            obstacle_relaxation=RELAXATION.replace(
                min_weight=self.min_weight, near=self.near, far=self.far
            ),
            limit_relaxation=LIMIT_RELAXATION.replace(
                min_weight=self.limit_min_weight, far=self.limit_far
            ),
            dither=rmp.SetpointDither(amplitude=self.dither),
        )
