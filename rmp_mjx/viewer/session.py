"""One or more copies of an arm in one scene: their state, their step, their history."""

from __future__ import annotations

import collections
import functools
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from rmp_mjx.names import unknown
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.robot import Robot
from rmp_mjx.robot.kinematics import site_pose
from rmp_mjx.viewer import physics
from rmp_mjx.viewer.dials import (
    CONTROLLERS,
    Dials,
    as_python,
    dials,
    make,
)
from rmp_mjx.viewer.insight import Insight, on_host
from rmp_mjx.viewer.objects import NONE, Objects
from rmp_mjx.viewer.player import kept
from rmp_mjx.viewer.steps import control, thought
from rmp_mjx.viewer.things import SCENES, SLOTS, Thing, obstacles

PERIOD = 0.005
"""Physics and control timestep [s]."""
KP = 150.0
"""Stiffness at the start [1/s^2]."""
_TREES = ("rmp_vices", "rmp_vices_literal")


class Numbers(NamedTuple):
    """One arm after one step; n joints."""

    q: np.ndarray
    """Joint positions, (n,) [rad]."""
    qd: np.ndarray
    """Joint velocities, (n,) [rad/s]."""
    qdd: np.ndarray
    """Acceleration that the controller wanted, (n,) [rad/s^2]."""
    tau: np.ndarray
    """Torques, (n,) [N m]."""
    tau_ext: np.ndarray
    """Joint torque of contacts and push, (n,) [N m]."""
    clearance: float
    """Least distance of a control point to a thing or the floor [m]."""
    force: float
    """Sum of the contacts' normal forces, without those of the hand's work [N]."""
    rest: tuple[np.ndarray, np.ndarray] = (np.zeros(0), np.zeros(0))
    """Positions and velocities of the joints of a task's objects."""
    objects: tuple[Thing, ...] = ()
    """The objects."""


class Frame(NamedTuple):
    """Everything at one time: a session can go on from it."""

    time: float
    """Simulated time [s]."""
    controllers: tuple[str, ...]
    """Who drives each arm."""
    arms: tuple[Numbers, ...]
    """The arms."""
    things: tuple[Thing, ...]
    """The things."""
    target: tuple[np.ndarray, np.ndarray]
    """Position [m] and orientation (wxyz) of the target."""
    cost: float
    """Wall time of the step [s]."""


class Session:
    """The arms, all from the same start, target and things, one for each controller."""

    period = PERIOD

    def __init__(
        self,
        robot: Robot,
        controllers: Sequence[str] = ("rmp_vices",),
        scene: str = "free",
        objects: Objects = NONE,
    ):
        """Build the model; nothing is compiled before the first step.

        Args:
            robot: The arm.
            controllers: Who drives: one arm for each.
            scene: Things to begin with.
            objects: A task's, which physics moves; each arm has its own.

        Raises:
            ValueError: Unknown controller or scene.
        """
        self.robot, self.objects = robot, objects
        self.model = physics.build(robot, PERIOD, objects)
        self._slots = objects.slots(self.model)
        self._work = frozenset(self.model.geom(name).id for name in objects.touch)
        self.base = {name: make(name, robot, PERIOD) for name in CONTROLLERS}
        self.dials: dict[str, Dials] = {n: dials(c) for n, c in self.base.items()}
        self.stiffness = {"kp_pos": KP, "kp_ori": KP}
        self.floor: float | None = None
        self.push: tuple[str, np.ndarray] | None = None
        self.things: tuple[Thing, ...] = ()
        self._made: tuple[Any, Obstacles] | None = None
        self.history: collections.deque[Frame] = collections.deque(maxlen=kept(PERIOD))
        self._control = jax.jit(functools.partial(control, self.base))
        self._think = {
            n: jax.jit(functools.partial(thought, self.base[n])) for n in _TREES
        }
        self.time = 0.0
        self.arms: list[mujoco.MjData] = []
        self.controllers: tuple[str, ...] = ()
        self.load(scene)
        self.set_floor(objects is not NONE)
        self.start(controllers)

    def start(self, controllers: Sequence[str] | None = None) -> None:
        """Put every arm at home and forget the history.

        Args:
            controllers: Who drives: one arm for each. None: the same as now.

        Raises:
            ValueError: There is none, or no such controller.
        """
        names = self.controllers if controllers is None else tuple(controllers)
        self._check(names)
        self.controllers = names
        self.time, self.push = 0.0, None
        self.arms = [self._at_home() for _ in names]
        self.history.clear()
        p, R = jax.jit(site_pose)(self.robot, jnp.asarray(self.robot.q_home))
        wxyz = np.zeros(4)
        mujoco.mju_mat2Quat(wxyz, np.asarray(R, float).ravel())
        self.target = np.asarray(p, float), wxyz

    def drive(self, controllers: Sequence[str]) -> None:
        """Other controllers for the arms that are there; new arms start as the first.

        Raises:
            ValueError: There is none, or no such controller.
        """
        self._check(controllers)
        first = self.arms[0]
        self.arms = self.arms[: len(controllers)]
        while len(self.arms) < len(controllers):
            self.arms.append(self._at(first.qpos, first.qvel))
        self.controllers = tuple(controllers)

    def load(self, scene: str) -> None:
        """Replace the things by those of a scene.

        Raises:
            ValueError: There is no such scene.
        """
        if scene not in SCENES:
            raise ValueError(unknown("scene", scene, list(SCENES)))
        self.scene = scene
        self.set_things(SCENES[scene])

    def set_things(self, things: Sequence[Thing]) -> None:
        """Put these things, and no others, into the arm's way.

        Raises:
            ValueError: More of a kind than there are slots.
        """
        for kind, slots in SLOTS.items():
            count = sum(thing.kind == kind for thing in things)
            if count > slots:
                raise ValueError(f"there can be at most {slots} of kind {kind}")
        self.things = tuple(things)
        physics.resize(self.model, self.things, self.floor)

    def set_floor(self, there: bool) -> None:
        """Put the floor in at its height, or take it away."""
        self.floor = self.objects.floor if there else None
        physics.resize(self.model, self.things, self.floor)

    def step(self) -> Frame:
        """One control and physics step of every arm."""
        began = time.perf_counter()
        self.things = tuple(thing.moved(PERIOD) for thing in self.things)
        numbers = tuple(
            self._step_one(data, name)
            for data, name in zip(self.arms, self.controllers, strict=True)
        )
        self.time += PERIOD
        cost = time.perf_counter() - began
        frame = Frame(
            self.time, self.controllers, numbers, self.things, self.target, cost
        )
        self.history.append(frame)
        return frame

    def _step_one(self, data: mujoco.MjData, name: str) -> Numbers:
        n, model = self.robot.n, self.model
        tau_ext = (physics.contact_torque(model, data) + self._push(data))[:n]
        around = self._around(self.things, self.objects.read(model, data))
        out = self._control(
            np.int32(list(CONTROLLERS).index(name)),
            self._packed(),
            *_single(data.qpos[:n], data.qvel[:n], *self.target),
            self._gains(),
            np.float32(self.time),
            around,
            *_single(tau_ext, data.ctrl),
        )
        tau, qdd, clearance = (np.asarray(x, float) for x in out)
        data.ctrl[:] = tau
        physics.place(self.model, data, self.things)
        mujoco.mj_step(model, data)
        return Numbers(
            data.qpos[:n].copy(),
            data.qvel[:n].copy(),
            qdd,
            tau,
            tau_ext,
            float(clearance),
            physics.contact_force(model, data, self._work),
            (data.qpos[n:].copy(), data.qvel[n:].copy()),
            self.objects.read(model, data),
        )

    def think(self, frame: Frame, arm: int = 0) -> Insight:
        """What the tree thinks of an arm in a frame.

        The tree is the one in charge, and the default one where VICES is.
        """
        name = frame.controllers[arm]
        tree = name if name in _TREES else "rmp_vices"
        now = frame.arms[arm]
        return on_host(
            self._think[tree](
                self._packed()[tree],
                *_single(now.q, now.qd, now.qdd, *frame.target),
                self._gains(),
                np.float32(frame.time),
                self._around(frame.things, now.objects),
                *_single(now.tau_ext),
            )
        )

    def body(self, name: str, arm: int = 0) -> np.ndarray:
        """Where a push on a link acts: its centre of mass, (3,) [m]."""
        data = self.arms[arm]
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        return data.body(name).xipos.copy()

    def restore(self, frame: Frame) -> None:
        """Go on from a frame; what came after it is forgotten."""
        while self.history and self.history[-1].time > frame.time:
            self.history.pop()
        self.time, self.controllers = frame.time, frame.controllers
        self.target = frame.target
        self.arms = [
            self._at([*arm.q, *arm.rest[0]], [*arm.qd, *arm.rest[1]])
            for arm in frame.arms
        ]
        self.set_things(frame.things)

    def hand(self, arm: int = 0) -> np.ndarray:
        """Position of an arm's end effector, (3,) [m]."""
        data = self.arms[arm]
        mujoco.mj_kinematics(self.model, data)
        return data.site(self.robot.site_name).xpos.copy()

    def as_python(self, name: str, robot: str) -> str:
        """The Python that makes a controller as its dials are now."""
        before = dials(self.base[name])
        changed = {k: v for k, v in self.dials[name].items() if v != before[k]}
        return as_python(name, robot, changed)

    def reset_dials(self, name: str) -> None:
        """Give a controller its default parameters."""
        self.dials[name] = dials(self.base[name])

    def _check(self, names: Sequence[str]) -> None:
        for name in names:
            if name not in CONTROLLERS:
                raise ValueError(unknown("controller", name, list(CONTROLLERS)))
        if not names:
            raise ValueError("there must be at least one controller")

    def _at_home(self) -> mujoco.MjData:
        return self._at([*self.robot.q_home, *self.objects.qpos], 0.0)

    def _at(self, qpos: ArrayLike, qvel: ArrayLike) -> mujoco.MjData:
        data = mujoco.MjData(self.model)
        data.qpos[:], data.qvel[:] = qpos, qvel
        physics.place(self.model, data, self.things)
        mujoco.mj_forward(self.model, data)
        return data

    def _push(self, data: mujoco.MjData) -> np.ndarray:
        """Apply the push, and its joint torque, (n,) [N m]."""
        data.xfrc_applied[:] = 0.0
        torque = np.zeros(self.model.nv)
        if self.push is not None:
            name, force = self.push
            body = self.model.body(name).id
            data.xfrc_applied[body, :3] = force
            at = data.xipos[body]
            mujoco.mj_applyFT(self.model, data, force, np.zeros(3), at, body, torque)
        return torque

    def _packed(self) -> dict[str, np.ndarray]:
        """The dials' values: few arrays are quicker to hand over than many numbers."""
        return {n: np.array([*d.values()], np.float32) for n, d in self.dials.items()}

    def _around(
        self, things: tuple[Thing, ...], objects: tuple[Thing, ...]
    ) -> Obstacles:
        """Things and objects as obstacles, made anew only when they change."""
        key = things, objects, self.floor
        if self._made is None or self._made[0] != key:
            found = obstacles([*things, *objects], self.floor, self._slots)
            self._made = key, jax.device_put(found)
        return self._made[1]

    def _gains(self) -> tuple[np.float32, np.float32]:
        return np.float32(self.stiffness["kp_pos"]), np.float32(
            self.stiffness["kp_ori"]
        )


def _single(*arrays: Any) -> list[np.ndarray]:
    return [np.asarray(x, np.float32) for x in arrays]
