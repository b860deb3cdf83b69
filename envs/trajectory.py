"""Trajectory following: visit four via points in order (VICES' free-space path)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from envs.base import ArmEnv, State
from envs.placement import LAYOUTS, place_spheres, sample_apart
from envs.scene import build_scene
from rmp_mjx.control import RMPVICES, VICES
from rmp_mjx.robot import Robot
from rmp_mjx.robot.kinematics import (
    arm_state,
    base_point,
    forward_kinematics,
    site_pose,
    site_state,
)
from rmp_mjx.sim import PhysicsState

BOX_LOW = np.array([0.30, -0.20, 0.03])
BOX_HIGH = np.array([0.55, 0.20, 0.28])
"""Corners of the via points' box in the arm's base frame [m]."""

OBSERVATIONS = ("rotated", "fixed")


class Trajectory(ArmEnv):
    """Reach four random via points, one after the other.

    Reward: 100 on reaching the current point (within 5 cm), else 30 (1 - tanh(5 d));
    on finishing 25 per step left of the episode; an event costs `event_penalty`.
    """

    n_points = 4
    reach = 0.05
    """A via point counts as reached within this distance [m]."""

    def __init__(
        self,
        controller: str | RMPVICES | VICES = "rmp_vices",
        physics: str = "auto",
        *,
        armature: str = "physical",
        robot: Robot | None = None,
        sim_dt: float = 0.005,
        obstacles: int = 0,
        sphere_radius: float = 0.05,
        layout: str = "far",
        observation: str = "rotated",
        event_penalty: float = 50.0,
        terminate_on_event: bool = True,
        terminate_on_success: bool = True,
        start_noise: float = 0.02,
    ):
        """Build the scene.

        Args:
            controller: `rmp_vices`, `vices`, or a controller object.
            physics: `auto`, `mujoco` (C engine) or `mjx`.
            armature: Rotor inertias of the Jaco 2: `physical` or `robosuite`.
            robot: An arm of your own instead; its start pose is `q_home`.
            sim_dt: Physics and control timestep [s]; must divide 0.05 s.
            obstacles: Random spheres in the via points' box, new in every episode.
            sphere_radius: Their radius [m].
            layout: Their clearances, `far` or `close`.
            observation: `rotated`: vectors to the via points, the current one first;
                `fixed`: the paper's list of positions and checked flags.
            event_penalty: Cost of a collision or joint-limit event.
            terminate_on_event: Whether such an event ends the episode.
            terminate_on_success: Whether the last via point ends the episode.
            start_noise: Standard deviation of the start configuration [rad].

        Raises:
            ValueError: An option has no such value; the message lists the valid ones.
        """
        for name, value, valid in (
            ("layout", layout, tuple(LAYOUTS)),
            ("observation", observation, OBSERVATIONS),
        ):
            if value not in valid:
                names = ", ".join(valid)
                raise ValueError(f"unknown {name} '{value}'; valid names: {names}")
        if obstacles < 0 or not sphere_radius > 0:
            raise ValueError(
                "obstacles must be at least 0 and sphere_radius positive, got "
                f"{obstacles} and {sphere_radius}"
            )
        robot = Robot.load("jaco2", armature=armature) if robot is None else robot
        scene = build_scene(robot, sim_dt, obstacles, sphere_radius)
        super().__init__(
            robot, controller, physics, scene, sim_dt, event_penalty, terminate_on_event
        )
        self.sphere_radius = sphere_radius
        self.layout = layout
        self.observation = observation
        self.terminate_on_success = terminate_on_success
        self.start_noise = start_noise

    @property
    def task_metrics(self) -> dict[str, str]:
        """Via points reached, success, and spheres that found no place."""
        return {"via_points": "sum", "success": "max", "unplaced_spheres": "max"}

    @property
    def observation_size(self) -> int:
        """Pose (3 + 9), velocity (6), via points (3 each) and flags (1 each)."""
        return 18 + 4 * self.n_points

    def reset(self, rng: Array) -> State:
        """Start near the home pose with new via points and spheres."""
        rng, key_q, key_points, key_spheres = jax.random.split(rng, 4)
        n = self.robot.n
        q = self.robot.q_home + self.start_noise * jax.random.normal(key_q, (n,))
        points, _ = sample_apart(key_points, self.n_points, BOX_LOW, BOX_HIGH, 0.10)
        spheres, placed = self._place(key_spheres, q, points)
        data = self.physics.init(q, jnp.zeros(n), spheres)
        info = {
            "rng": rng,
            "points": points,
            "reached": jnp.zeros((), jnp.int32),
            "placed": placed,
            "step": jnp.zeros((), jnp.int32),
        }
        metrics = {name: jnp.zeros(()) for name in self.metric_reductions}
        return State(
            data=data,
            obs=self._observe(data, points, info["reached"]),
            reward=jnp.zeros(()),
            done=jnp.zeros(()),
            metrics=metrics,
            info=info,
        )

    def _place(self, rng: Array, q: Array, points: Array) -> tuple[Array, Array]:
        """Sphere centres and which found a place; the others wait below the floor."""
        count = self.scene.spheres
        p, R = forward_kinematics(self.robot, q)
        segment = np.array(self.robot.points.segment)
        offset = jnp.asarray(self.robot.points.offset, p.dtype)
        arm = p[:, segment].T + jnp.einsum("ijk,kj->ki", R[:, :, segment], offset)
        centers, placed = place_spheres(
            rng,
            count,
            self.sphere_radius,
            self.layout,
            BOX_LOW,
            BOX_HIGH,
            points,
            base_point(self.robot) + arm,
            jnp.asarray(self.robot.points.radius),
        )
        return jnp.where(placed[:, None], centers, jnp.array([0.0, 0.0, -5.0])), placed

    def step(self, state: State, action: Float[Array, " 12"]) -> State:
        """Hold the action for one policy step and score where it led."""
        info = state.info
        obstacles = self.obstacles(state.data, info["placed"])
        data, setpoint, record = self.drive(state.data, action, obstacles)
        position, _ = site_pose(self.robot, data.qpos)
        k = jnp.minimum(info["reached"], self.n_points - 1)
        distance = jnp.linalg.norm(info["points"][k] - position)
        unfinished = info["reached"] < self.n_points
        hit = unfinished & (distance < self.reach)
        reached = info["reached"] + hit
        finished = hit & (reached == self.n_points)
        step = info["step"] + 1
        shaped = jnp.where(unfinished, 30.0 * (1.0 - jnp.tanh(5.0 * distance)), 0.0)
        reward = jnp.where(hit, 100.0, shaped)
        reward += jnp.where(finished, 25.0 * (self.episode_length - step), 0.0)
        reward -= jnp.where(record.event, self.event_penalty, 0.0)
        done = finished & self.terminate_on_success
        done |= record.event & self.terminate_on_event
        obs = self._observe(data, info["points"], reached)
        bad = ~(jnp.all(jnp.isfinite(obs)) & jnp.all(jnp.abs(data.qvel) < 1e3))
        tracking_error = jnp.linalg.norm(setpoint.p_des - position)
        metrics = self.safety_metrics(record, tracking_error, bad)
        metrics |= {
            "via_points": hit.astype(jnp.float32),
            "success": finished.astype(jnp.float32),
            "unplaced_spheres": jnp.sum(~info["placed"]).astype(jnp.float32),
        }
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            data=data,
            obs=jnp.where(bad, 0.0, obs),
            reward=jnp.where(bad, 0.0, reward),
            done=(done | bad).astype(jnp.float32),
            metrics={k: jnp.nan_to_num(v) for k, v in metrics.items()},
            info=info | {"reached": reached, "step": step},
        )

    def _observe(self, data: PhysicsState, points: Array, reached: Array) -> Array:
        """End-effector pose and velocity, via points and their flags."""
        site = site_state(self.robot, arm_state(self.robot, data.qpos, data.qvel))
        checked = (jnp.arange(self.n_points) < reached).astype(jnp.float32)
        if self.observation == "rotated":
            order = (jnp.arange(self.n_points) + reached) % self.n_points
            points, checked = points[order] - site.p, checked[order]
        return jnp.concatenate(
            [site.p, site.R.reshape(-1), site.v, site.w, points.reshape(-1), checked]
        )
