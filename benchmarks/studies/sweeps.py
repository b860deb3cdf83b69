"""What the robustness study varies, and how it evaluates the outcome."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.studies.random_policies import NEAR, REACHING_LIMIT, poisson
from benchmarks.studies.safety_study import Group, Study
from envs.arms import JACO
from envs.safety import ENDING

CONTROLLERS = {"rmp_vices": "RMP-VICES", "vices": "VICES"}
"""Controllers and their names in the tables."""

RANDOM = ("smooth", "hard")
"""Random policies, in the order of the tables."""


class Cell(NamedTuple):
    """One value of every varied setting; the defaults vary nothing."""

    noise: float = 0.0
    """Noise of the sphere positions that the controller sees [m]."""
    delay: float = 0.0
    """Delay of these positions [s]."""
    speed: float = 0.0
    """Speed of the spheres [m/s]."""
    spheres: int = 2
    """Number of spheres."""
    torque: float = 1.0
    """Usable share of the torque limits."""
    layout: str = "close"
    """Layout of the spheres under the random policies."""
    sim_dt: float = 0.005
    """Physics and control timestep [s]."""
    armature: str = "physical"
    """Rotor inertias."""

    @property
    def name(self) -> str:
        """The settings that are not at their defaults."""
        default = Cell()._asdict()
        changed = {k: v for k, v in self._asdict().items() if v != default[k]}
        return ",".join(f"{k}={v}" for k, v in changed.items()) or "default"

    @property
    def program(self) -> Program:
        """Its compiled program."""
        return Program(self.sim_dt, self.armature, 8 if self.spheres != 2 else 2)

    def groups(self, worlds: int) -> tuple[Group, ...]:
        """`worlds` for each random policy, half as many to reach among far spheres."""
        names = ("spheres", "speed", "noise", "delay", "torque")
        special = {name: getattr(self, name) for name in names}
        random = [Group(p, worlds, self.layout, **special) for p in RANDOM]
        share = max(worlds // 2, 1)
        return (*random, Group("straight", share, "far", REACHING_LIMIT, **special))


class Program(NamedTuple):
    """Options that need their own compiled program."""

    sim_dt: float
    """Timestep [s]."""
    armature: str
    """Rotor inertias."""
    slots: int
    """Slots for spheres."""


class Axis(NamedTuple):
    """A setting and its values."""

    title: str
    """Title of the first column of its table."""
    cells: dict[str, Cell]
    """The values by their names in the table."""


AXES = {
    "noise": Axis(
        "noise", {f"{1e3 * x:g} mm": Cell(noise=x) for x in (0, 5e-3, 0.01, 0.02, 0.04)}
    ),
    "delay": Axis(
        "speed of the spheres, delay",
        {
            f"{v:g} m/s, {1e3 * x:g} ms": Cell(speed=v, delay=x)
            for v in (0.0, 0.1, 0.2, 0.4)
            for x in ((0.0, 0.05, 0.1, 0.2, 0.4) if v else (0.0,))
        },
    ),
    "spheres": Axis("spheres", {f"{n}": Cell(spheres=n) for n in (0, 2, 4, 8)}),
    "layout": Axis("layout", {x: Cell(layout=x) for x in ("close", "far")}),
    "torque": Axis(
        "torque limits", {f"{100 * x:g} %": Cell(torque=x) for x in (1.0, 0.5, 0.25)}
    ),
    "timestep": Axis(
        "timestep",
        {f"{1e3 * x:g} ms": Cell(sim_dt=x) for x in (0.001, 0.002, 0.005, 0.01)},
    ),
    "armature": Axis(
        "armature", {x: Cell(armature=x) for x in ("physical", "robosuite")}
    ),
}
"""The varied settings. Without speed a delay changes nothing."""


class Outcome(NamedTuple):
    """Result of one controller under one random policy in one cell."""

    steps: int
    """Policy steps."""
    collisions: int
    """Collisions, hand included, and self-collisions."""
    limits: int
    """Joint-limit events."""
    progress: float
    """Way along the commanded displacement in a policy step, as a share of it."""
    torque_jump: float
    """99th percentile of a policy step's largest torque change [N m]."""
    jerk: float
    """99th percentile of a policy step's largest joint jerk [rad/s^3]."""
    turns: float
    """Joint velocities that change sign near an obstacle [1/s]."""
    saturation: float
    """Share of the physics steps with a torque at its limit."""
    unplaced: float
    """Mean number of spheres without a place; unused slots count too."""

    @property
    def rate(self) -> float:
        """Events per 1,000 policy steps."""
        return 1e3 * (self.collisions + self.limits) / self.steps

    @property
    def interval(self) -> tuple[float, float]:
        """Exact 95 % interval of `rate`."""
        low, high = poisson(self.collisions + self.limits)
        return 1e3 * low / self.steps, 1e3 * high / self.steps


class Reaching(NamedTuple):
    """Via points that one controller reached in one cell."""

    reached: int
    """Reached via points."""
    missed: int
    """Episodes that ended before the last one, by an event or after 15 s."""
    lost: int
    """Those that ended by an event."""

    @property
    def share(self) -> float:
        """Share of the attempted via points that were reached."""
        return self.reached / max(self.reached + self.missed, 1)


Results = Mapping[tuple[str, str, str], Any]
"""`Outcome` or `Reaching` by cell, controller and policy."""


def judge(figures: dict[str, np.ndarray]) -> Outcome:
    """Count what happened under a random policy; figures are (steps, worlds) each."""
    near = figures["clearance"] < NEAR
    count = lambda *events: int(sum(figures[e].sum() for e in events))  # noqa: E731
    return Outcome(
        steps=figures["collision"].size,
        collisions=count("collision", "self_collision"),
        limits=count("joint_limit"),
        progress=float(figures["moved"].sum() / figures["commanded"].sum()),
        torque_jump=float(np.quantile(figures["torque_jump"], 0.99)),
        jerk=float(np.quantile(figures["joint_jerk"], 0.99)),
        turns=float(figures["turns"][near].sum() / max(near.sum(), 1) / 0.05),
        saturation=float(figures["torque_saturation"].mean()),
        unplaced=float(figures["unplaced_obstacles"].mean()),
    )


def judge_reaching(figures: dict[str, np.ndarray]) -> Reaching:
    """Count via points; figures are (steps, worlds) each."""
    over, age = figures["over"].astype(bool), figures["age"]
    # Only episodes that started with time left: a run's end would cut short the slow.
    whole = np.arange(len(age))[:, None] - age < len(age) - REACHING_LIMIT
    event = sum(figures[e] for e in ENDING) > 0
    missed = over & whole & ~(figures["success"] > 0)
    return Reaching(
        reached=int(figures["via_points"][whole].sum()),
        missed=int(missed.sum()),
        lost=int((missed & event).sum()),
    )


def cells_of(controller: str, axes: Sequence[str]) -> dict[Program, list[Cell]]:
    """The cells to run, by program. VICES ignores obstacles, so it needs fewer."""
    found: dict[Program, list[Cell]] = {}
    for cell in dict.fromkeys(c for a in axes for c in AXES[a].cells.values()):
        if controller == "rmp_vices" or not (cell.noise or cell.delay):
            found.setdefault(cell.program, []).append(cell)
    return found


def sweep(
    axes: Sequence[str], worlds: int, steps: int, seed: int, robot: str = JACO
) -> Iterator[tuple[tuple[str, str, str], Outcome | Reaching]]:
    """Run every cell of these axes with both controllers."""
    for controller in CONTROLLERS:
        for program, cells in cells_of(controller, axes).items():
            began = time.perf_counter()
            groups = {cell: cell.groups(worlds) for cell in cells}
            study = Study(
                controller,
                [group for each in groups.values() for group in each],
                steps,
                robot=robot,
                physics="mujoco",
                sim_dt=program.sim_dt,
                armature=program.armature,
                obstacles=program.slots,
            )
            figures = study.run(study.env.controller, seed)
            for cell, each in groups.items():
                for group in each:
                    judged = judge if group.policy in RANDOM else judge_reaching
                    key = cell.name, controller, group.policy
                    yield key, judged(figures[group])
            took = time.perf_counter() - began
            print(f"{controller}, {program}: {len(cells)} cells, {took:.0f} s")
