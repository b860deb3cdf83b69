"""An arm under a controller among obstacles, and what happens in one policy step."""

from __future__ import annotations

import functools
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from envs.options import CONTROLLERS, substeps
from envs.safety import Motion, SafetyRecord, Torques, observe
from envs.scene import TABLE_HEIGHT, build_scene
from envs.spheres import Spheres
from envs.task import OptionsT, Task
from rmp_mjx import sim
from rmp_mjx.control import RMPVICES, Controller, Leaves
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.robot import Robot
from rmp_mjx.robot.kinematics import (
    SiteState,
    arm_state,
    point_positions,
    site_state,
)
from rmp_mjx.shapes import Gap
from rmp_mjx.sim import PhysicsState
from rmp_mjx.types import Setpoint
from rmp_mjx.vec import Vec


class World(Task[OptionsT]):
    """A task's arm, controller, scene and physics."""

    def __init__(
        self,
        options: OptionsT,
        robot: Robot | None = None,
        controller: Controller | None = None,
    ):
        """Build them.

        Args:
            options: The task's options.
            robot: An arm of your own instead of the Jaco 2; it starts at its `q_home`.
            controller: A controller object instead of the options' named one.
        """
        self.options = options
        self._own = {"arm": robot is not None, "controller": controller is not None}
        self.robot = self._jaco() if robot is None else robot
        self.controller = self._named_controller() if controller is None else controller
        self.scene = build_scene(
            self.robot,
            options.sim_dt,
            options.obstacles,
            options.sphere_radius,
            options.cone,
            self.objects,
        )
        self.physics = sim.load_physics(options.physics, self.scene.model)
        self.sim_dt = options.sim_dt
        self.n_substeps = substeps(options.sim_dt)

    def _jaco(self) -> Robot:
        """The Jaco 2; its posture leaf rests where the task starts."""
        robot = Robot.load("jaco2", armature=self.options.armature)
        return robot.replace(q_home=self.q_start)

    def _named_controller(self) -> Controller:
        """The options' controller; the task's leaves take the place of default ones."""
        controller = CONTROLLERS[self.options.controller](self.robot)
        collision = self.collision_leaves(self.robot)
        if collision and isinstance(controller, RMPVICES):
            default = controller.leaves == Leaves.default(self.robot)
            return controller.with_collision(collision) if default else controller
        return controller

    @property
    def identity(self) -> dict[str, str]:
        """What the options do not say: the arm, and a controller that is an object.

        Runs record it. The Jaco 2 is as in the library: its rotor inertias are an
        option, and its posture is the task's.
        """
        arm = self.robot if self._own["arm"] else Robot.load("jaco2")
        found = {"arm": f"'{arm.name}' (fingerprint {arm.fingerprint[:12]})"}
        if self._own["controller"]:
            found["controller"] = f"'{type(self.controller).__name__}' of your own"
        return found

    @property
    def engine(self) -> str:
        """Physics engine, timestep and friction cone, for titles and tables."""
        name = next(n for n, k in sim.ENGINES.items() if isinstance(self.physics, k))
        return f"{name}, {1e3 * self.sim_dt:g} ms, {self.options.cone}"

    def obstacles(
        self, data: PhysicsState, spheres: Spheres, error: Array | float = 0.0
    ) -> Obstacles:
        """Table, fixtures and spheres, as the controller sees them.

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
        radius, delay = self.options.sphere_radius, self.options.obstacle_delay
        return spheres.perceive(slots, data.mocap_pos, radius, error, delay)

    def drive(
        self,
        data: PhysicsState,
        spheres: Spheres,
        action: Float[Array, " 12"],
        error: Array | float = 0.0,
        time: Array | float = 0.0,
    ) -> tuple[PhysicsState, Spheres, Setpoint, SafetyRecord]:
        """Hold one action for a policy step; the controller runs every physics step.

        Args:
            data: Physics.
            spheres: The spheres.
            action: Action in [-1, 1].
            error: Error of the spheres' measured positions, (k, 3) [m].
            time: Time of the policy step [s].

        Returns:
            Physics and spheres afterwards, the set-point that was held, and what
            happened.
        """
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
                out.diagnostics["torque_limit"],
            )
            record = record.then(now, 1.0 / self.n_substeps)
            return (data, spheres, torques, motion, record), None

        before = Torques.start(n), Motion.start(data.qvel[:n])
        start = (data, spheres, *before, SafetyRecord.empty())
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
        """Distances of all control points to the obstacles, kind by kind."""
        x = Vec.of(point_positions(self.robot, data.qpos[: self.robot.n]), 1)
        rest = x.map(jnp.zeros_like)
        points = self.robot.points
        rho = jnp.asarray(points.radius, data.qpos.dtype)
        return self.obstacles(data, spheres).gaps(x, rest, rho, points.hand).values()

    def clearance(self, data: PhysicsState, spheres: Spheres) -> Float[Array, ""]:
        """Least distance of a control point to an obstacle [m]."""
        nearest = (
            jnp.min(jnp.where(gap.active, gap.distance, jnp.inf))
            for gap in self.gaps(data, spheres)
        )
        return functools.reduce(jnp.minimum, nearest)
