"""What all tasks share: the state, the policy step, events and their record."""

from __future__ import annotations

import abc
import functools
from collections.abc import Iterable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from envs import options
from envs.placement import place_spheres
from envs.safety import Motion, SafetyRecord, Torques, observe
from envs.scene import TABLE_HEIGHT, Contacts, build_scene, no_objects
from envs.spheres import AWAY, Spheres
from envs.types import ARM_ENTRIES, METRICS, SHARED, Entry, Score, State
from rmp_mjx.control import ACTION_SIZE, Controller
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.rmp import ScalarLeaf
from rmp_mjx.robot import Robot
from rmp_mjx.robot.kinematics import (
    SiteState,
    arm_state,
    point_positions,
    site_state,
)
from rmp_mjx.shapes import Gap
from rmp_mjx.sim import ENGINES, PhysicsState, load_physics
from rmp_mjx.types import Setpoint
from rmp_mjx.vec import Vec


class ArmEnv(abc.ABC):
    """An arm under a controller, driven by a policy at 20 Hz.

    `reset` and `step` are pure functions of one environment; callers vmap them. A task
    says what its scene, start, score and observation are.
    """

    dt = options.CTRL_DT
    """Seconds per policy step."""
    action_size = ACTION_SIZE
    """Entries of an action in [-1, 1]."""

    Options: ClassVar[type[options.Options]] = options.Options
    """The task's options."""
    q_start: ClassVar[np.ndarray]
    """Start configuration of the Jaco 2, (7,) [rad]."""
    sphere_box: ClassVar[tuple[np.ndarray, np.ndarray]]
    """Corners of the box for the spheres' centres [m]."""
    task_metrics: ClassVar[dict[str, str]] = {}
    """The task's own metrics and their reductions."""
    fixture_slots: ClassVar[dict[str, int]] = {}
    """Obstacle slots that `fixtures` fills, by kind, besides the table's plane."""

    def __init__(
        self,
        asked: options.Options,
        robot: Robot | None = None,
        controller: Any = None,
    ):
        """Put the pieces together.

        Args:
            asked: Options.
            robot: An arm of your own instead of the Jaco 2; it starts at its `q_home`.
            controller: A controller object instead of the options' named one.
        """
        self.options = asked
        if robot is None:
            # The posture leaf rests where the task starts.
            robot = Robot.load("jaco2", armature=asked.armature)
            robot = robot.replace(q_home=self.q_start)
        if controller is None:
            controller = options.CONTROLLERS[asked.controller](robot)
            leaves = self.collision_leaves(robot)
            if asked.controller == "rmp_vices" and leaves:
                controller = controller.with_collision(leaves)
        self.robot: Robot = robot
        self.controller: Controller = controller
        self.scene = build_scene(
            robot,
            asked.sim_dt,
            asked.obstacles,
            asked.sphere_radius,
            asked.cone,
            self.objects,
        )
        self.physics = load_physics(asked.physics, self.scene.model)
        self.sim_dt = asked.sim_dt
        self.episode_length = asked.episode_length
        self.n_substeps = options.substeps(asked.sim_dt)
        self.metric_reductions = METRICS | self.task_metrics

    # What a task says.

    def collision_leaves(self, robot: Robot) -> dict[str, ScalarLeaf]:
        """Leaves of `rmp_vices` by kind of obstacle, where the default does not fit."""
        return {}

    @property
    @abc.abstractmethod
    def task_entries(self) -> tuple[Entry, ...]:
        """The task's part of the observation."""

    @abc.abstractmethod
    def begin(
        self, rng: Array, q: Float[Array, " n"]
    ) -> tuple[Array, dict[str, Array]]:
        """Positions of the objects' joints, and the task's part of `State.info`."""

    @abc.abstractmethod
    def score(
        self,
        data: PhysicsState,
        site: SiteState,
        record: SafetyRecord,
        task: dict[str, Array],
        step: Array,
    ) -> Score:
        """Judge the policy step that led to `data`; `step` counts it."""

    @abc.abstractmethod
    def observe(
        self, data: PhysicsState, site: SiteState, task: dict[str, Array]
    ) -> dict[str, Array]:
        """The task's part of the observation, an array for each of `task_entries`."""

    @abc.abstractmethod
    def keep_clear(self, task: dict[str, Array]) -> Float[Array, "v 3"]:
        """Points that the spheres' layout keeps clear [m]."""

    def objects(self, spec: mujoco.MjSpec) -> Contacts:
        """Add the task's objects to the scene."""
        return no_objects(spec)

    def fixtures(self, slots: Obstacles, data: PhysicsState) -> Obstacles:
        """Fill in the fixtures that the tree avoids besides the table."""
        del data
        return slots

    # What all tasks share.

    @property
    def name(self) -> str:
        """The task's name."""
        return self.options.env

    @property
    def engine(self) -> str:
        """Physics engine, timestep and friction cone, in words."""
        name = next(n for n, kind in ENGINES.items() if isinstance(self.physics, kind))
        return f"{name}, {1e3 * self.sim_dt:g} ms, {self.options.cone}"

    @property
    def entries(self) -> tuple[Entry, ...]:
        """The observation, entry by entry."""
        return ARM_ENTRIES + self.task_entries

    @property
    def observation_size(self) -> int:
        """Numbers in an observation."""
        return sum(entry.size for entry in self.entries)

    def reset(self, rng: Array) -> State:
        """Start near the start configuration, everything random drawn anew."""
        rng, key_q, key_task, key_spheres, key_motion = jax.random.split(rng, 5)
        model, n = self.scene.model, self.robot.n
        q = jnp.asarray(self.robot.q_home, jnp.float32)
        q = q + self.options.start_noise * jax.random.normal(key_q, (n,))
        objects, task = self.begin(key_task, q)
        centers, placed = self._place(key_spheres, q, task)
        spheres = Spheres.start(key_motion, placed, self.options.obstacle_speed)
        data = self.physics.init(
            jnp.concatenate([q, objects]), jnp.zeros(model.nv), centers
        )
        going_on = {name: jnp.zeros((), bool) for name in SafetyRecord.none().flags}
        info = {
            "rng": rng,
            "step": jnp.zeros((), jnp.int32),
            "spheres": spheres,
            "going_on": going_on,
        }
        return State(
            data=data,
            obs=self._observation(data, self.site(data), task),
            reward=jnp.zeros(()),
            done=jnp.zeros(()),
            metrics={name: jnp.zeros(()) for name in self.metric_reductions},
            info=info | task,
        )

    def step(self, state: State, action: Float[Array, " 12"]) -> State:
        """Hold the action for one policy step and score where it led."""
        asked, info = self.options, state.info
        rng, key = jax.random.split(info["rng"])
        error = asked.obstacle_noise * jax.random.normal(key, (self.scene.spheres, 3))
        data, spheres, setpoint, record = self.drive(
            state.data, info["spheres"], action, error, self.dt * info["step"]
        )
        step = info["step"] + 1
        task = {name: value for name, value in info.items() if name not in SHARED}
        site = self.site(data)
        score = self.score(data, site, record, task, step)
        obs = self._observation(data, site, score.task)
        bad = ~(jnp.all(jnp.isfinite(obs)) & jnp.all(jnp.abs(data.qvel) < 1e3))
        reward = score.reward - jnp.where(record.event, asked.event_penalty, 0.0)
        done = score.success & asked.terminate_on_success
        done |= record.event & asked.terminate_on_event
        metrics = self._events(record, info["going_on"])
        metrics |= {
            "success": score.success,
            "contact_force": record.force,
            "contact_force_peak": record.force_peak,
            "contact_impulse": record.force * self.dt,
            "work_force": record.work_force,
            "work_force_peak": record.work_force_peak,
            "clearance": self.clearance(data, spheres),
            "torque_saturation": record.saturation,
            "torque_jump": record.torque_jump,
            "torque_reversals": record.reversals,
            "joint_jerk": record.jerk,
            "tracking_error": jnp.linalg.norm(setpoint.p_des - site.p),
            "unplaced_obstacles": jnp.sum(~spheres.placed),
            "contact_overflow": record.overflow,
            "nonfinite": bad,
        }
        metrics |= score.metrics
        return state.replace(
            data=data,
            obs=jnp.where(bad, 0.0, obs),
            reward=jnp.where(bad, 0.0, reward),
            done=(done | bad).astype(jnp.float32),
            metrics=state.metrics
            | {
                k: jnp.nan_to_num(jnp.asarray(v, jnp.float32))
                for k, v in metrics.items()
            },
            info=info
            | {"rng": rng, "step": step, "spheres": spheres, "going_on": record.flags}
            | score.task,
        )

    def obstacles(
        self, data: PhysicsState, spheres: Spheres, error: Array | float = 0.0
    ) -> Obstacles:
        """Table, fixtures and spheres, as the controller is told of them.

        Args:
            data: Physics.
            spheres: The spheres.
            error: Error of the spheres' measured positions, (k, 3) [m].
        """
        table = np.array([[0.0, 0.0, TABLE_HEIGHT]])
        slots = Obstacles.empty(
            spheres=self.scene.spheres, planes=1, **self.fixture_slots
        ).with_planes(table, np.array([[0.0, 0.0, 1.0]]))
        slots = self.fixtures(slots, data)
        if not self.scene.spheres:
            return slots
        asked = self.options
        return spheres.perceive(
            slots, data.mocap_pos, asked.sphere_radius, error, asked.obstacle_delay
        )

    def drive(
        self,
        data: PhysicsState,
        spheres: Spheres,
        action: Float[Array, " 12"],
        error: Array | float = 0.0,
        time: Array | float = 0.0,
    ) -> tuple[PhysicsState, Spheres, Setpoint, SafetyRecord]:
        """Hold one action for a policy step; the tree runs at every physics step."""
        ctrl, n = self.controller, self.robot.n
        setpoint = ctrl.setpoint(data.qpos[:n], ctrl.decode(action), time)

        def substep(carry, _):
            data, spheres, torques, motion, record = carry
            seen = self.obstacles(data, spheres, error)
            out = ctrl(data.qpos[:n], data.qvel[:n], setpoint, seen)
            if self.options.obstacle_speed and self.scene.spheres:
                centers, spheres = spheres.move(
                    data.mocap_pos, self.sim_dt, *self.sphere_box
                )
                data = data.replace(mocap_pos=centers)
            data = self.physics.step(data, out.tau)
            now = observe(
                self.scene,
                self.robot,
                data,
                torques := torques.then(out.tau),
                motion := motion.then(data.qvel[:n], self.sim_dt),
                out.diagnostics["torque_scale"],
            )
            record = record.then(now, 1.0 / self.n_substeps)
            return (data, spheres, torques, motion, record), None

        before = Torques.none(n), Motion.none(data.qvel[:n])
        start = (data, spheres, *before, SafetyRecord.none())
        (data, spheres, _, _, record), _ = jax.lax.scan(
            substep, start, None, length=self.n_substeps
        )
        return data, spheres, setpoint, record

    def site(self, data: PhysicsState) -> SiteState:
        """Pose and velocity of the grip site."""
        n = self.robot.n
        return site_state(
            self.robot, arm_state(self.robot, data.qpos[:n], data.qvel[:n])
        )

    def gaps(self, data: PhysicsState, spheres: Spheres) -> Iterable[Gap]:
        """Distances of all control points to what the tree avoids, kind by kind."""
        x = Vec.of(point_positions(self.robot, data.qpos[: self.robot.n]), 1)
        rest = x.map(jnp.zeros_like)
        points = self.robot.points
        rho = jnp.asarray(points.radius, data.qpos.dtype)
        return self.obstacles(data, spheres).gaps(x, rest, rho, points.hand).values()

    def clearance(self, data: PhysicsState, spheres: Spheres) -> Float[Array, ""]:
        """Least distance of a control point to what the tree avoids [m]."""
        nearest = (
            jnp.min(jnp.where(gap.active, gap.distance, jnp.inf))
            for gap in self.gaps(data, spheres)
        )
        return functools.reduce(jnp.minimum, nearest)

    def _place(
        self, rng: Array, q: Array, task: dict[str, Array]
    ) -> tuple[Array, Array]:
        """Sphere centres and which found a place; the others wait far below."""
        centers, placed = place_spheres(
            rng,
            self.scene.spheres,
            self.options.sphere_radius,
            self.options.layout,
            *self.sphere_box,
            self.keep_clear(task),
            point_positions(self.robot, q),
            jnp.asarray(self.robot.points.radius),
        )
        return jnp.where(placed[:, None], centers, jnp.array(AWAY)), placed

    def _observation(
        self, data: PhysicsState, site: SiteState, task: dict[str, Array]
    ) -> Array:
        """All entries in one vector."""
        values = {
            "position": site.p,
            "rotation": site.R,
            "velocity": site.v,
            "angular_velocity": site.w,
        }
        values |= self.observe(data, site, task)
        return jnp.concatenate([values[e.name].reshape(-1) for e in self.entries])

    def _events(
        self, record: SafetyRecord, going_on: dict[str, Array]
    ) -> dict[str, Array]:
        """Which events began in this step."""
        return {name: on & ~going_on[name] for name, on in record.flags.items()}
