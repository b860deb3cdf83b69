"""Environments: `reset` and `step` of a task."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.control import ACTION_SIZE
from rmp_mjx.control.controller import ImpedanceController
from rmp_mjx.metric import Metric, by_name
from rmp_mjx.robot.kinematics import SiteState, point_positions
from rmp_mjx.shapes import Spheres as SphereSlots
from rmp_mjx.sim import PhysicsState
from rmp_mjx.types import LeafWeights

from . import sight
from .options import CTRL_DT
from .placement import place_spheres
from .randomisation import draw_model
from .safety import SafetyRecord
from .spheres import AWAY, LEVEL, Course, Spheres, draw_count, draw_speed
from .task import OptionsT
from .types import METRICS, Measures, State
from .world import World

PARTS = ("dpos", "drot", "kp_pos", "kp_ori")
ACTION_NAMES = (
    *(f"{part}_{axis}" for part in PARTS for axis in "xyz"),
    *(field.name for field in dataclasses.fields(LeafWeights)),
)
"""Entries of an action in [-1, 1]: see `rmp_mjx.Action` and `LeafWeights`."""

TOO_FAST = 1e3
"""A joint velocity beyond this counts as non-finite [rad/s]."""


class ArmEnv(World[OptionsT]):
    """An arm under a controller, driven by a policy at 20 Hz.

    `reset` and `step` are pure functions of one environment; callers vmap them. What
    differs between tasks is in `envs.task.Task`. `State.info` holds the random key
    (`rng`), the policy steps so far (`step`), the spheres (`spheres`), what the
    controller remembers (`control`, see `ControlMemory`), the events that are still
    going on (`active_events`), and the task's own part (`task`); with a curriculum also
    its stage (`course`). Keys that a wrapper adds pass through.
    """

    dt = CTRL_DT
    """Seconds per policy step."""

    @property
    def action_size(self) -> int:
        """Entries of an action in [-1, 1]."""
        return getattr(self.controller, "action_size", ACTION_SIZE)

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of an action's entries; none for a controller of another kind."""
        known = isinstance(self.controller, ImpedanceController)
        return ACTION_NAMES[: self.action_size] if known else ()

    @property
    def episode_length(self) -> int:
        """Policy steps until the time limit, which the caller enforces."""
        return self.options.episode_length

    @property
    def metrics(self) -> dict[str, Metric]:
        """What `State.metrics` holds, by name."""
        own = (LEVEL,) if self.options.obstacle_curriculum else ()
        return by_name([*METRICS.values(), *self.task_metrics, *own])

    def reset(self, rng: Array) -> State:
        """Start near the start configuration, everything random drawn anew.

        A curriculum is at its end here: episodes have the options' whole world.
        """
        return self._start(rng, Course.at(1.0))

    def restart(self, rng: Array, ended: State | None) -> State:
        """As `reset`, in training: with what the curriculum allows, if there is one.

        Args:
            rng: Key.
            ended: Last state of the environment's episode before; None: it is the
                first.
        """
        if not self.options.obstacle_curriculum:
            return self.reset(rng)
        before = Course.at(0.0) if ended is None else ended.info["course"].following()
        return self._start(rng, before)

    def _start(self, rng: Array, course: Course) -> State:
        """A start with no more than the curriculum's level of the options' spheres."""
        rng, key_q, key_task, key_spheres, key_motion = jax.random.split(rng, 5)
        q = self.start_of(jax.random.normal(key_q, (self.robot.n,)))
        objects, task = self.begin(key_task, q)
        centers, spheres = self._spheres(key_spheres, key_motion, course.level, q, task)
        return self.opening(rng, q, objects, task, centers, spheres, course)

    def start_of(self, z: Float[Array, " n"]) -> Float[Array, " n"]:
        """Start configuration of standard normal numbers [rad]."""
        q = jnp.asarray(self.robot.q_home, jnp.float32)
        return q + self.options.start_noise * z

    def opening(
        self,
        rng: Array,
        q: Float[Array, " n"],
        objects: Float[Array, " o"],
        task: dict[str, Array],
        centers: Float[Array, "k 3"],
        spheres: Spheres,
        course: Course,
    ) -> State:
        """The state before the first step of an episode whose world is given.

        Args:
            rng: Key of what is random during the episode.
            q: Joint coordinates of the arm, at rest [rad].
            objects: Positions of the task's objects, and...
            task: ...the task's part of the state: what `begin` returns.
            centers: Centres of the spheres [m].
            spheres: Their state.
            course: The curriculum.
        """
        key_motors, key_model = (jax.random.fold_in(rng, i) for i in (1, 2))
        data = self.physics.init(
            jnp.concatenate([q, objects]), jnp.zeros(self.scene.model.nv), centers
        ).replace(model=draw_model(key_model, self.options, self.scene.model))
        return State(
            data=data,
            obs=self._observation(data, self.site(data), task, spheres, rng),
            reward=jnp.zeros(()),
            done=jnp.zeros(()),
            metrics={name: jnp.zeros(()) for name in self.metrics},
            info={
                "rng": rng,
                "step": jnp.zeros((), jnp.int32),
                "spheres": spheres,
                "control": self.remember(q, key_motors),
                "active_events": SafetyRecord.empty().events,
                "task": task,
            }
            | ({"course": course} if self.options.obstacle_curriculum else {}),
        )

    def step(self, state: State, action: Float[Array, " m"]) -> State:
        """Hold the action for one policy step and score where it led."""
        options, info = self.options, state.info
        rng, key = jax.random.split(info["rng"])
        data, spheres, control, setpoint, record = self.drive(
            state.data,
            info["spheres"],
            action,
            info["control"],
            self.sphere_error(key),
            self.dt * info["step"],
            jax.random.fold_in(key, 1),
        )
        step = info["step"] + 1
        site = self.site(data)
        score = self.score(data, site, record, state.task, step)
        obs = self._observation(data, site, score.task, spheres, rng)
        finite = jnp.all(jnp.isfinite(obs)) & jnp.all(jnp.abs(data.qvel) < TOO_FAST)
        bad = ~finite
        reward = score.reward - jnp.where(record.event, options.event_penalty, 0.0)
        done = score.success & options.terminate_on_success
        done |= record.event & options.terminate_on_event
        measured = Measures(
            success=score.success,
            contact_impulse=record.contact_force * self.dt,
            clearance=self.clearance(data, spheres),
            tracking_error=jnp.linalg.norm(setpoint.p_des - site.p),
            unplaced_obstacles=spheres.missing,
            nonfinite=bad,
        )
        active = info["active_events"]
        begun = {name: on & ~active[name] for name, on in record.events.items()}
        metrics = begun | record.values | measured.values | score.metrics
        course = {}
        if options.obstacle_curriculum:
            course["course"] = info["course"].then(score.success, record.event)
            metrics[LEVEL.name] = info["course"].level
        return state.replace(
            data=data,
            obs=jnp.where(bad, 0.0, obs),
            reward=jnp.where(bad, 0.0, reward),
            done=(done | bad).astype(jnp.float32),
            # Wrappers may have metrics of their own.
            metrics=state.metrics
            | {
                name: jnp.nan_to_num(jnp.asarray(value, jnp.float32))
                for name, value in metrics.items()
            },
            info=info
            | {
                "rng": rng,
                "step": step,
                "spheres": spheres,
                "control": control,
                "active_events": record.events,
                "task": score.task,
            }
            | course,
        )

    def _spheres(
        self,
        key_place: Array,
        key_motion: Array,
        level: Array | float,
        q: Array,
        task: dict[str, Array],
    ) -> tuple[Array, Spheres]:
        """Centres and state of an episode's spheres; unused slots wait far below."""
        options, slots = self.options, self.scene.spheres
        centers, fits = place_spheres(
            key_place,
            slots,
            options.sphere_radius,
            options.layout,
            *self.sphere_box,
            self.keep_clear(task),
            point_positions(self.robot, q),
            jnp.asarray(self.robot.points.radius),
        )
        # Keys of their own: the default options draw nothing more than they always did.
        key_count, key_speed = (
            jax.random.fold_in(key, 1) for key in (key_place, key_motion)
        )
        wanted = draw_count(key_count, slots, options.obstacle_count == "random", level)
        speed = draw_speed(
            key_speed,
            options.obstacle_speed * level,
            options.obstacle_motion == "always",
        )
        spheres = Spheres.start(key_motion, wanted, fits, speed)
        return jnp.where(spheres.placed[:, None], centers, jnp.array(AWAY)), spheres

    def sphere_error(self, key: Array) -> Array:
        """Error of the spheres' measured positions in a policy step, (k, 3) [m]."""
        noise = jax.random.normal(key, (self.scene.spheres, 3))
        return self.options.obstacle_noise * noise

    def _observation(
        self,
        data: PhysicsState,
        site: SiteState,
        task: dict[str, Array],
        spheres: Spheres,
        rng: Array,
    ) -> Array:
        """All entries in one vector; `rng` is the key of the next step."""

        def measured() -> SphereSlots:
            """What the controller gets in the next step."""
            error = self.sphere_error(jax.random.split(rng)[1])
            return self.obstacles(data, spheres, error).spheres

        q = data.qpos[: self.robot.n]
        return self.assemble(site, q, self.observe(data, site, task), measured)

    def assemble(
        self,
        site: SiteState,
        q: Float[Array, " n"],
        values: dict[str, Array],
        spheres: Callable[[], SphereSlots],
    ) -> Array:
        """All entries of an observation in one vector.

        Args:
            site: The grip.
            q: Joint positions of the arm [rad].
            values: The task's entries, from `observe`.
            spheres: Gives the spheres as the controller sees them; called if the policy
                sees any.
        """
        values = {
            "position": site.p,
            "rotation": site.R,
            "velocity": site.v,
            "angular_velocity": site.w,
        } | values
        if self.options.seen_spheres:
            values |= sight.look(
                self.options.seen_spheres,
                site,
                spheres(),
                point_positions(self.robot, q),
                jnp.asarray(self.robot.points.radius),
            )
        return jnp.concatenate([values[e.name].reshape(-1) for e in self.entries])
