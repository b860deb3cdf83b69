"""What all tasks share: the state, the policy step, the safety record."""

from __future__ import annotations

import abc
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from envs.safety import SafetyRecord, observe
from envs.scene import TABLE_HEIGHT, Scene
from rmp_mjx.control import ACTION_SIZE, RMPVICES, VICES
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.robot import Robot
from rmp_mjx.sim import PhysicsState, load_physics
from rmp_mjx.types import Setpoint

CONTROLLERS = {"rmp_vices": RMPVICES, "vices": VICES}
"""Controllers by name."""

SAFETY_METRICS = {
    "collision": "sum",
    "arm_collision": "sum",
    "self_collision": "sum",
    "joint_limit": "sum",
    "turn_limit": "sum",
    "contact_force": "mean",
    "contact_force_peak": "max",
    "torque_saturation": "mean",
    "tracking_error": "mean",
    "nonfinite": "max",
}
"""Metrics of every task and how a step's value folds into the episode's."""


@struct.dataclass
class State:
    """State of one environment (the Brax and Playground convention)."""

    data: PhysicsState
    """Physics."""
    obs: Float[Array, " n"]
    """Observation."""
    reward: Float[Array, ""]
    """Reward of the last step."""
    done: Float[Array, ""]
    """1 if the episode ended, by the task or by a safety event."""
    metrics: dict[str, Array]
    """Scalars of the last step; the keys never change."""
    info: dict[str, Any]
    """What the task carries along; the keys never change."""


class ArmEnv(abc.ABC):
    """An arm under a controller, driven by a policy at 20 Hz.

    `reset` and `step` are pure functions of one environment; callers vmap them.
    """

    dt = 0.05
    """Seconds per policy step."""
    action_size = ACTION_SIZE
    """Entries of an action in [-1, 1]."""
    episode_length = 1024
    """Policy steps until the time limit, which the caller enforces."""

    def __init__(
        self,
        robot: Robot,
        controller: str | RMPVICES | VICES,
        physics: str,
        scene: Scene,
        sim_dt: float,
        event_penalty: float,
        terminate_on_event: bool,
    ):
        """Put the pieces together; see `envs.load` for the options."""
        self.robot = robot
        if isinstance(controller, str):
            if controller not in CONTROLLERS:
                raise ValueError(
                    f"unknown controller '{controller}'; valid names: "
                    f"{', '.join(CONTROLLERS)}"
                )
            controller = CONTROLLERS[controller](robot)
        self.controller: RMPVICES | VICES = controller
        self.scene = scene
        self.physics = load_physics(physics, scene.model)
        self.sim_dt = sim_dt
        self.n_substeps = substeps(self.dt, sim_dt)
        self.event_penalty = event_penalty
        self.terminate_on_event = terminate_on_event
        self.metric_reductions = SAFETY_METRICS | self.task_metrics

    @property
    @abc.abstractmethod
    def task_metrics(self) -> dict[str, str]:
        """The task's own metrics and their reductions."""

    @property
    @abc.abstractmethod
    def observation_size(self) -> int:
        """Entries of an observation."""

    @abc.abstractmethod
    def reset(self, rng: Array) -> State:
        """Start an episode."""

    @abc.abstractmethod
    def step(self, state: State, action: Float[Array, " 12"]) -> State:
        """One policy step."""

    def obstacles(self, data: PhysicsState, active: Array) -> Obstacles:
        """The table and the scene's spheres, as the controller sees them."""
        table = np.array([[0.0, 0.0, TABLE_HEIGHT]])
        slots = Obstacles.empty(spheres=self.scene.spheres, planes=1).with_planes(
            table, np.array([[0.0, 0.0, 1.0]])
        )
        if not self.scene.spheres:
            return slots
        radius = self.scene.model.geom("sphere_0").size[0]
        slots = slots.with_spheres(data.mocap_pos, np.full(self.scene.spheres, radius))
        spheres = slots.spheres.replace(active=active)
        return slots.replace(spheres=spheres)

    def drive(
        self, data: PhysicsState, action: Float[Array, " 12"], obstacles: Obstacles
    ) -> tuple[PhysicsState, Setpoint, SafetyRecord]:
        """Hold one action for a policy step; the tree runs at every physics step."""
        ctrl, n = self.controller, self.robot.n
        setpoint = ctrl.setpoint(data.qpos[:n], ctrl.decode(action))

        def substep(carry, _):
            data, record = carry
            out = ctrl(data.qpos[:n], data.qvel[:n], setpoint, obstacles)
            data = self.physics.step(data, out.tau)
            now = observe(self.scene, self.robot, data, out.diagnostics["torque_scale"])
            return (data, record.then(now, 1.0 / self.n_substeps)), None

        start = (data, SafetyRecord.none())
        (data, record), _ = jax.lax.scan(substep, start, None, length=self.n_substeps)
        return data, setpoint, record

    def safety_metrics(
        self, record: SafetyRecord, tracking_error: Array, bad: Array
    ) -> dict[str, Array]:
        """The step's values of `SAFETY_METRICS`."""
        return {
            "collision": record.collision.astype(jnp.float32),
            "arm_collision": record.arm_collision.astype(jnp.float32),
            "self_collision": record.self_collision.astype(jnp.float32),
            "joint_limit": record.joint_limit.astype(jnp.float32),
            "turn_limit": record.turn_limit.astype(jnp.float32),
            "contact_force": record.force,
            "contact_force_peak": record.force_peak,
            "torque_saturation": record.saturation,
            "tracking_error": tracking_error,
            "nonfinite": bad.astype(jnp.float32),
        }


def substeps(dt: float, sim_dt: float) -> int:
    """Physics steps per policy step.

    Raises:
        ValueError: The timestep is not positive or does not divide the policy step.
    """
    if not (np.isfinite(sim_dt) and 0 < sim_dt <= dt):
        raise ValueError(f"sim_dt must be in (0, {dt}] s, got {sim_dt}")
    n = round(dt / sim_dt)
    if abs(n * sim_dt - dt) > 1e-9:
        raise ValueError(f"sim_dt={sim_dt} s does not divide the policy step of {dt} s")
    return n
