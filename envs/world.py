"""An arm under a controller among obstacles, and what happens in one policy step."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rmp_mjx import sim
from rmp_mjx.control import (
    Controller,
    StopGuard,
    WeightedActionRange,
)
from rmp_mjx.control.observer import ContactObserver
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.pytree import Pytree
from rmp_mjx.robot import Robot
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import (
    SiteState,
    arm_state,
    point_positions,
    site_state,
)
from rmp_mjx.shapes import Gap
from rmp_mjx.sim import PhysicsState
from rmp_mjx.types import ControlOutput, Setpoint
from rmp_mjx.vec import Vec

from . import impacts
from .arms import JACO, fit
from .options import CONTROLLERS, substeps
from .randomisation import draw_motors
from .safety import Motion, SafetyRecord, Torques, observe
from .scene import TABLE_HEIGHT, build_scene
from .spheres import Spheres
from .task import OptionsT, Task
from .types import ControlMemory


class Noise(Pytree):
    """Errors of what is measured."""

    observer: Float[Array, "*k n"]
    """Of the joint velocities that the observer gets, its own [rad/s]."""
    position: Float[Array, "*k n"]
    """Of the joint positions that controller and observer get [rad]."""
    velocity: Float[Array, "*k n"]
    """Of the joint velocities that both get [rad/s]."""


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
            robot: An arm object instead of the options' named one. It is taken as it
                is: its base is the origin, and it starts at its `q_home`.
            controller: A controller object instead of the options' named one.

        Raises:
            RobotError: There is no arm of that name, or it does not fit the task.
            ValueError: There is an observer, and the controller takes no `tau_ext`; or
                `leaf_weights` is to change a controller object.
        """
        if options.leaf_weights and controller is not None:
            raise ValueError(
                "leaf_weights is for the named controller: give your own one "
                "action_range=WeightedActionRange()"
            )
        self.options = options
        self._own = {"arm": robot is not None, "controller": controller is not None}
        self.mount = np.zeros(3)
        self.robot = self._named_arm() if robot is None else robot
        self.controller = self._named_controller() if controller is None else controller
        self.scene = build_scene(
            self.robot,
            options.sim_dt,
            options.obstacles,
            options.sphere_radius,
            options.cone,
            self.objects,
            self.mount,
        )
        self.physics = sim.load_physics(options.physics, self.scene.model)
        self.sim_dt = options.sim_dt
        self.n_substeps = substeps(options.sim_dt)
        self.observer = self._named_observer()

    def _named_arm(self) -> Robot:
        """The options' arm; its posture leaf rests where the task starts."""
        if self.options.robot == JACO:
            robot = Robot.load(JACO, armature=self.options.armature)
            return robot.replace(q_home=self.q_start)
        robot, self.mount, start = fit(self.options.robot, type(self))
        return robot.replace(q_home=start)

    def _named_controller(self) -> Controller:
        """The options' controller."""
        controller = CONTROLLERS[self.options.controller](self.robot)
        controller = controller.replace(period=self.options.sim_dt)
        if self.options.guard:
            controller = controller.replace(guard=self._guard())
        if self.options.leaf_weights:
            controller = controller.replace(action_range=WeightedActionRange())
        return controller

    def _guard(self) -> StopGuard:
        """The guard of the arm, for the spheres of the options."""
        options = self.options
        seen_late = options.obstacle_speed * options.obstacle_delay
        return StopGuard.of(
            self.robot,
            options.sim_dt,
            obstacle_speed=options.obstacle_speed,
            obstacle_error=seen_late + 4.0 * options.obstacle_noise,
        )

    def _named_observer(self) -> ContactObserver | None:
        """The options' observer of contact torque."""
        options = self.options
        if options.observer == "none":
            return None
        if not _takes(self.controller, "tau_ext"):
            raise ValueError(
                f"observer={options.observer} gives the controller tau_ext=, which "
                f"'{type(self.controller).__name__}' does not take: add the argument "
                "to its __call__, or choose observer=none"
            )
        gain = options.observer_gain if options.observer == "momentum" else None
        band, delay = options.observer_dead_band, options.observer_steps
        return ContactObserver.of(self.robot, gain, band, delay)

    @property
    def identity(self) -> dict[str, str]:
        """What the options do not say: the arm, and a controller that is an object.

        Runs record it. A named arm is as it is in all tasks: its posture is the task's,
        and the rotor inertias of the Jaco 2 are an option.
        """
        arm, name = self.robot, self.options.robot
        if not self._own["arm"]:
            arm = Robot.load(JACO) if name == JACO else fit(name, type(self)).robot
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

    def remember(
        self, q: Float[Array, " n"], rng: Array | None = None
    ) -> ControlMemory:
        """What is known of the control before an episode: the arm is held at rest.

        Args:
            q: Joint positions, (n,) [rad].
            rng: Randomness of the motors; None: they do as they are told.
        """
        contact = None if self.observer is None else self.observer.start(self.robot.n)
        arm = arm_state(self.robot, q, jnp.zeros_like(q))
        hold = self._applied(dynamics(self.robot, arm)[1])
        motors = None
        if rng is not None:
            motors = draw_motors(rng, self.options, hold, self.sim_dt)
        limited = self.robot.tau_rate_max is not None
        return ControlMemory(contact, hold if limited else None, motors)

    def control(
        self,
        data: PhysicsState,
        spheres: Spheres,
        setpoint: Any,
        memory: ControlMemory,
        error: Array | float = 0.0,
        noise: Noise | None = None,
    ) -> tuple[ControlOutput, ControlMemory]:
        """One control step: the controller, with what an arm can measure of contacts.

        Args:
            data: Physics.
            spheres: The spheres.
            setpoint: Target, from the controller's `setpoint`.
            memory: From `remember`, or from the last control step.
            error: Error of the spheres' measured positions, (k, 3) [m].
            noise: Errors of what is measured; None: none.

        Returns:
            The controller's output, and the memory for the next step.
        """
        n, felt, contact = self.robot.n, {}, memory.contact
        q, qd = data.qpos[:n], data.qvel[:n]
        measured = qd
        if noise is not None:
            q, qd = q + noise.position, qd + noise.velocity
            measured = qd + noise.observer
        if self.observer is not None and contact is not None:
            felt["tau_ext"], contact = self.observer.estimate(
                contact, measured, self.sim_dt
            )
        if memory.tau is not None and _takes(self.controller, "tau_last"):
            felt["tau_last"] = memory.tau
        seen = self.obstacles(data, spheres, error)
        out = self.controller(q, qd, setpoint, seen, **felt)
        tau = self._applied(out.tau)
        if contact is not None:
            contact = contact.then(out.Mq, out.bias, tau)
        last = None if memory.tau is None else tau
        motors = None if memory.motors is None else memory.motors.then(out.tau)
        return out, ControlMemory(contact, last, motors)

    def _applied(self, tau: Float[Array, " n"]) -> Float[Array, " n"]:
        """Torques as the motors give them, within their ranges [N m]."""
        low, high = self.scene.model.actuator_ctrlrange[: self.robot.n].T
        return jnp.clip(tau, jnp.asarray(low, tau.dtype), jnp.asarray(high, tau.dtype))

    def drive(
        self,
        data: PhysicsState,
        spheres: Spheres,
        action: Float[Array, " m"],
        memory: ControlMemory,
        error: Array | float = 0.0,
        time: Array | float = 0.0,
        key: Array | None = None,
    ) -> tuple[PhysicsState, Spheres, ControlMemory, Setpoint, SafetyRecord]:
        """Hold one action for a policy step; the controller runs every physics step.

        Args:
            data: Physics.
            spheres: The spheres.
            action: Action in [-1, 1].
            memory: From `remember`, or from the last policy step.
            error: Error of the spheres' measured positions, (k, 3) [m].
            time: Time of the policy step [s].
            key: Randomness of what is measured; None: no noise.

        Returns:
            Physics, spheres and memory afterwards, the set-point that was held, and
            what happened.
        """
        ctrl, n = self.controller, self.robot.n
        setpoint = ctrl.setpoint(data.qpos[:n], ctrl.decode(action), time)

        def substep(carry, noise):
            data, spheres, memory, torques, motion, touched, record = carry
            last = memory.tau
            out, memory = self.control(data, spheres, setpoint, memory, error, noise)
            velocity = spheres.velocity
            if self.options.obstacle_speed and self.scene.spheres:
                centers, spheres = spheres.move(
                    data.mocap_pos, self.sim_dt, *self.sphere_box
                )
                data = data.replace(mocap_pos=centers)
            before, data = data, self.physics.step(data, memory.acting(out.tau))
            touching = impacts.touching(self.scene, data)
            now = observe(
                self.scene,
                self.robot,
                data,
                torques := torques.then(out.tau),
                motion := motion.then(data.qvel[:n], self.sim_dt),
                out.diagnostics["torque_limit"],
                None if last is None or memory.tau is None else memory.tau - last,
                _guarded(ctrl, out, data.qvel[:n]),
            )
            moment = impacts.Moment(
                qpos=before.qpos,
                qvel=before.qvel,
                centers=before.mocap_pos,
                velocity=velocity,
                begun=touching & ~touched,
            )
            record = record.then(now, 1.0 / self.n_substeps)
            parts = torques, motion, touching, record
            return (data, spheres, memory, *parts), moment

        touched = impacts.touching(self.scene, data)
        before = Torques.start(n), Motion.start(data.qvel[:n]), touched
        start = (data, spheres, memory, *before, SafetyRecord.empty())
        (data, spheres, memory, _, _, _, record), moments = jax.lax.scan(
            substep, start, self.noise(key), length=self.n_substeps
        )
        impact = impacts.measure(self.scene, self.robot, moments)
        record = record.replace(
            at_fault=impact.at_fault,
            contact_speed=impact.own,
            closing_speed=impact.closing,
            contact_energy=impact.energy,
        )
        return data, spheres, memory, setpoint, record

    def noise(self, key: Array | None) -> Noise | None:
        """Errors of what is measured in a policy step, each (steps, n).

        Args:
            key: Randomness; None: no noise.
        """
        names = "observer_noise", "position_noise", "velocity_noise"
        deviations = [getattr(self.options, name) for name in names]
        if key is None or not any(deviations):
            return None
        keys = key, *(jax.random.fold_in(key, i) for i in (1, 2))
        shape = (self.n_substeps, self.robot.n)
        return Noise(
            *(
                deviation * jax.random.normal(own, shape)
                for deviation, own in zip(deviations, keys, strict=True)
            )
        )

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


def _guarded(
    controller: Controller, out: ControlOutput, qd: Float[Array, " n"]
) -> tuple[Array, Array] | None:
    """What the controller's guard did, and whether it had no proof; None without one.

    Args:
        controller: The controller.
        out: Its output.
        qd: Joint velocities after the step, (n,) [rad/s].
    """
    guard, found = getattr(controller, "guard", None), out.diagnostics
    if guard is None:
        return None
    broken = ~guard.kept(found["guard_qd"], qd) | (found["guard_assumptions"] > 0)
    return found["guard_used"], broken


def _takes(controller: Controller, name: str) -> bool:
    """Whether the controller can be given an argument of this name."""
    parameters = inspect.signature(controller).parameters.values()
    return any(p.name == name or p.kind == p.VAR_KEYWORD for p in parameters)
