"""Options of a task: one dataclass, checked before anything is built."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, ClassVar, Literal

from rmp_mjx.control import RMPVICES, VICES, rmp_vices_literal
from rmp_mjx.control.cbf import FilteredVICES
from rmp_mjx.control.vices import OSC
from rmp_mjx.fields import check
from rmp_mjx.robot.library import find

from .arms import JACO
from .placement import Layout
from .randomisation import Randomisation

ControllerName = Literal["rmp_vices", "vices", "rmp_vices_literal", "osc", "vices_cbf"]

CONTROLLERS = {
    "rmp_vices": RMPVICES,
    "vices": VICES,
    "rmp_vices_literal": rmp_vices_literal,
    "osc": OSC,
    "vices_cbf": FilteredVICES,
}
"""Controllers by name: each makes one for a robot."""

CTRL_DT = 0.05
"""Seconds per policy step."""

SHORTEST_STEP = 1e-4
"""Least physics timestep [s]: 500 steps per policy step."""
MOST_OBSTACLES = 500
"""Spheres that a task can have."""

_AT_LEAST_ZERO = (
    "obstacles",
    "obstacle_speed",
    "obstacle_noise",
    "obstacle_delay",
    "observer_noise",
    "observer_delay",
    "observer_dead_band",
    "seen_spheres",
    "start_noise",
    "position_noise",
    "velocity_noise",
)


@dataclasses.dataclass(frozen=True)
class Options(Randomisation):
    """Options of every task; a task adds its own in a subclass.

    They are flags of the command line, too: an option that takes one of a few names is
    a `Literal`.
    """

    env: ClassVar[str]
    """Name of the task."""
    controller: ControllerName = "rmp_vices"
    """Low-level controller that the policy commands: rmp_vices, vices,
    rmp_vices_literal (the paper's formulas with their signs corrected), osc (vices with
    a fixed impedance), or vices_cbf (vices behind a safety filter)."""
    robot: str = JACO
    """Arm: a name of rmp_mjx.robots(), or a path of an MJCF, a URDF or a .toml."""
    leaf_weights: bool = False
    """The policy also weighs attractor, posture and standoff of the tree: three more
    entries of an action. For rmp_vices alone."""
    physics: Literal["auto", "mujoco", "mjx", "warp"] = "auto"
    """Physics engine: mujoco (C threads), mjx (JAX), warp (MuJoCo Warp; extra `warp`),
    or auto: mujoco on a CPU, else mjx."""
    armature: Literal["physical", "robosuite"] = "physical"
    """Rotor inertias of the Jaco 2; any other arm has its own."""
    sim_dt: float = 0.005
    """Physics and control timestep [s]; must divide 0.05 s."""
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    """MuJoCo's friction cone."""
    obstacles: int = 0
    """Random spheres, new in every episode."""
    obstacle_count: Literal["fixed", "random"] = "fixed"
    """fixed: every episode has `obstacles` spheres; random: 0 to `obstacles`."""
    sphere_radius: float = 0.05
    """Their radius [m]."""
    layout: Layout = "far"
    """How near they may be at the start."""
    obstacle_speed: float = 0.0
    """Speed of the spheres, each in a random direction [m/s]."""
    obstacle_motion: Literal["always", "sometimes"] = "always"
    """always: they have that speed in every episode; sometimes: they rest in half of
    the episodes, and have any speed up to it in the others."""
    obstacle_curriculum: bool = False
    """In training, begin without spheres: an environment gets more and faster ones
    after an episode that is solved, fewer and slower ones after an event."""
    obstacle_noise: float = 0.0
    """Standard deviation of the sphere positions that the controller sees, drawn
    anew at every policy step [m]."""
    obstacle_delay: float = 0.0
    """Delay of the sphere positions that the controller sees [s]."""
    guard: bool = False
    """Put `StopGuard` behind the controller, for spheres of this speed, noise and
    delay."""
    observer: Literal["none", "momentum", "exact"] = "momentum"
    """What tells the controller the contacts' joint torque: nothing, a momentum
    observer, or its one-step form, which is exact in simulation and one step late."""
    observer_gain: float = 100.0
    """Bandwidth of the momentum observer [1/s]."""
    observer_noise: float = 0.0
    """Standard deviation of the joint velocities that the observer gets, drawn anew at
    every control step [rad/s]."""
    observer_delay: float = 0.0
    """Delay of the observer's torque [s]; a multiple of `sim_dt`."""
    observer_dead_band: float = 0.0
    """Torque of a joint that the observer counts as none [N m]."""
    seen_spheres: int = 0
    """The policy sees so many nearest spheres, as the controller sees them; 0: none."""
    event_penalty: float = 50.0
    """Cost of a collision or joint-limit event."""
    terminate_on_event: bool = True
    """Whether such an event ends the episode."""
    terminate_on_success: bool = False
    """Whether solving the task ends the episode."""
    episode_length: int = 1024
    """Policy steps until the time limit."""
    start_noise: float = 0.02
    """Standard deviation of the start configuration [rad]."""

    def __post_init__(self):
        """Check the values.

        Raises:
            ValueError: An option has no such value; the message lists the valid ones.
            RobotError: There is no such arm; likewise.
        """
        check(self)
        super().__post_init__()
        find(self.robot)
        if self.robot != JACO and self.armature != "physical":
            raise ValueError(
                f"armature={self.armature} is for the Jaco 2: leave it out for "
                f"'{self.robot}', which has rotor inertias of its own"
            )
        substeps(self.sim_dt)
        if self.leaf_weights and self.controller != "rmp_vices":
            raise ValueError(
                "leaf_weights shapes the tree of controller rmp_vices; "
                f"{self.controller} has none that a policy may shape"
            )
        if self.obstacles > MOST_OBSTACLES:
            raise ValueError(
                f"obstacles must be at most {MOST_OBSTACLES}, got {self.obstacles}: "
                "each is a body of the simulation"
            )
        for name in _AT_LEAST_ZERO:
            if not getattr(self, name) >= 0:
                raise ValueError(
                    f"{name} must be at least 0, got {getattr(self, name)}"
                )
        if not self.observer_gain > 0:
            raise ValueError(
                f"observer_gain must be positive, got {self.observer_gain}"
            )
        if abs(self.observer_steps * self.sim_dt - self.observer_delay) > 1e-9:
            raise ValueError(
                f"observer_delay={self.observer_delay} s is no multiple of the control "
                f"step of {self.sim_dt} s"
            )
        if self.episode_length < 1:
            raise ValueError(
                f"episode_length must be at least 1, got {self.episode_length}"
            )
        if not self.sphere_radius > 0:
            raise ValueError(
                f"sphere_radius must be positive, got {self.sphere_radius}"
            )

    @property
    def title(self) -> str:
        """Task, controller and arm, for figures and folder names."""
        arm = "" if self.robot == JACO else f", {Path(self.robot).stem}"
        return f"{self.env}, {self.controller}{arm}"

    @property
    def spheres(self) -> str:
        """The obstacles in words."""
        if not self.obstacles:
            return "no obstacles"
        upto = {"random": "up to ", "sometimes": "up to "}
        count = upto.get(self.obstacle_count, "")
        words = {"speed": f"speed {upto.get(self.obstacle_motion, '')}"}
        extra = [
            f", {words.get(name, f'{name} ')}{value:g}"
            for name in ("speed", "noise", "delay")
            if (value := getattr(self, f"obstacle_{name}"))
        ]
        return f"{count}{self.obstacles} spheres ({self.layout}{''.join(extra)})"

    @property
    def observer_steps(self) -> int:
        """Control steps of `observer_delay`."""
        return round(self.observer_delay / self.sim_dt)

    def record(self) -> dict[str, Any]:
        """The options by name, `env` first, JSON-ready."""
        values = dataclasses.asdict(self).items()
        return {"env": self.env} | {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in values
        }


def substeps(sim_dt: float) -> int:
    """Physics steps per policy step.

    Raises:
        ValueError: The timestep is not positive or does not divide the policy step.
    """
    if not SHORTEST_STEP <= sim_dt <= CTRL_DT:
        raise ValueError(
            f"sim_dt must be in [{SHORTEST_STEP:g}, {CTRL_DT}] s, got {sim_dt}"
        )
    n = round(CTRL_DT / sim_dt)
    if abs(n * sim_dt - CTRL_DT) > 1e-9:
        raise ValueError(
            f"sim_dt={sim_dt} s does not divide the policy step of {CTRL_DT} s"
        )
    return n
