"""How cost grows with the problem: ``python -m benchmarks.scaling --json F --plot P``.

Environments, control points, obstacles, joints: one curve each, with the exponent p of
time ~ size^p fitted to the upper half of the sizes. Memory is measured too.
"""

from __future__ import annotations

import argparse
import resource
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import envs
import rmp_mjx as rmp
from benchmarks.common import Row, measure, show, write_json
from benchmarks.png import save_figure
from benchmarks.speed.bench_controller import random_states
from benchmarks.speed.gate import state_bytes
from rmp_mjx import runtime

ENVIRONMENTS = (1, 4, 16, 64, 256, 1024, 4096, 16384)
POINTS = (16, 32, 64, 128, 256)
OBSTACLES = (0, 1, 2, 4, 8, 16, 32, 64)
JOINTS = (3, 5, 7, 9, 11, 14)
BATCH = 512
"""States in a batch of the controller's sweeps."""


@dataclass(frozen=True)
class Curve:
    """Times over sizes."""

    name: str
    """What grows."""
    unit: str
    """What is timed."""
    sizes: tuple[int, ...]
    """Sizes."""
    times: tuple[float, ...]
    """Seconds of each."""

    @property
    def exponent(self) -> float:
        """Slope of log time over log size in the upper half of the sizes."""
        half = len(self.sizes) // 2
        sizes, times = self.sizes[half:], self.times[half:]
        return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])

    def rows(self) -> list[Row]:
        """A row for each size and one for the exponent."""
        rows = [
            Row(f"us_{self.name}_{size}", 1e6 * time, "us", self.unit)
            for size, time in zip(self.sizes, self.times, strict=True)
        ]
        note = f"of time over {self.name}, upper half of the sizes"
        return [*rows, Row(f"exponent_{self.name}", self.exponent, "", note)]


def chain(joints: int) -> str:
    """MJCF of a serial arm: links of 0.9 m / joints with axes that turn in space.

    Every link carries a capsule, so the number of control points grows with it.
    """
    length = 0.9 / joints
    axes = ("0 0 1", "0 1 0", "1 0 0")
    body = '<site name="tip" pos="0 0 {length}"/>'
    for k in reversed(range(joints)):
        place = f"0 0 {length}" if k else "0 0 0.1"
        body = f"""<body name="link_{k}" pos="{place}">
          <joint name="joint_{k}" axis="{axes[k % 3]}" range="-2.5 2.5" armature="0.1"/>
          <geom name="geom_{k}" type="capsule" size="0.03" mass="0.5"
                fromto="0 0 0 0 0 {length}"/>
          {body}
        </body>"""
    motors = "".join(
        f'<motor name="motor_{k}" joint="joint_{k}" ctrlrange="-30 30"/>'
        for k in range(joints)
    )
    text = f"""<mujoco><compiler angle="radian"/>
      <worldbody>{body}</worldbody><actuator>{motors}</actuator></mujoco>"""
    return text.replace("{length}", str(length))


def controller_time(
    ctrl: rmp.RMPVICES, obstacles: rmp.Obstacles, seconds: float
) -> float:
    """Seconds of one evaluation in a batch."""
    q, qd, action, _ = random_states(ctrl.robot, BATCH, seed=0)
    setpoint = jax.jit(jax.vmap(ctrl.setpoint, in_axes=(0, 0, None)))(q, action, 0.0)

    def torque(q, qd, setpoint, obstacles):
        return jax.vmap(ctrl, in_axes=(0, 0, 0, None))(q, qd, setpoint, obstacles).tau

    return measure(torque, q, qd, setpoint, obstacles, seconds=seconds).median / BATCH


def spheres(number: int) -> rmp.Obstacles:
    """Spheres of 5 cm in the arm's reach."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(-np.pi, np.pi, number)
    height = rng.uniform(0.0, 0.6, number)
    centers = np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), height], axis=1)
    return rmp.Obstacles.empty(spheres=number).with_spheres(
        jnp.asarray(centers, jnp.float32), jnp.full(number, 0.05)
    )


def environments(sizes: Sequence[int], seconds: float) -> tuple[Curve, list[Row]]:
    """Time of a policy step of trajectory (C engine), and its memory."""
    env = envs.load("trajectory", controller="rmp_vices", physics="mujoco")
    reset, step = jax.jit(jax.vmap(env.reset)), jax.vmap(env.step)
    times, rows = [], []
    for size in sizes:
        state = reset(jax.random.split(jax.random.key(0), size))
        shape = (size, env.action_size)
        action = jax.random.uniform(jax.random.key(1), shape, minval=-1.0)
        times.append(measure(step, state, action, seconds=seconds).median)
        note = f"of the process so far, {size} environments"
        rows.append(Row(f"peak_rss_mib_{size}", peak_rss(), "MiB", note))
    return Curve("environments", "policy step", tuple(sizes), tuple(times)), rows


def control_points(sizes: Sequence[int], seconds: float) -> Curve:
    """RMP-VICES with five spheres and ever denser control points."""
    found, times = [], []
    for size in sizes:
        robot = _with_points(size)
        found.append(len(robot.points.segment))
        times.append(controller_time(rmp.RMPVICES(robot), spheres(5), seconds))
    return Curve("points", "evaluation", tuple(found), tuple(times))


def obstacles(sizes: Sequence[int], seconds: float) -> Curve:
    """RMP-VICES with ever more spheres; 0 is timed and left out of the curve."""
    ctrl = rmp.RMPVICES(rmp.Robot.load("jaco2"))
    times = [controller_time(ctrl, spheres(size), seconds) for size in sizes]
    return Curve("obstacles", "evaluation", tuple(sizes), tuple(times))


def joints(sizes: Sequence[int], seconds: float) -> Curve:
    """RMP-VICES of generated chains with five spheres, no self-collision."""
    times = []
    for size in sizes:
        robot = rmp.Robot.from_mjcf(chain(size), site="tip", spacing=0.03)
        leaves = rmp.Leaves.default(robot).replace(self_collision=None)
        ctrl = rmp.RMPVICES(robot, leaves)
        times.append(controller_time(ctrl, spheres(5), seconds))
    return Curve("joints", "evaluation", tuple(sizes), tuple(times))


def _with_points(wanted: int) -> rmp.Robot:
    """The Jaco 2 with about this number of control points."""
    low, high = 1e-3, 0.5
    for _ in range(12):
        middle = np.sqrt(low * high)
        robot = rmp.Robot.load("jaco2", spacing=float(middle))
        low, high = (
            (middle, high) if len(robot.points.segment) > wanted else (low, middle)
        )
    return robot  # pyright: ignore[reportPossiblyUnboundVariable]


def peak_rss() -> float:
    """Largest resident memory of this process so far [MiB]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def state_rows() -> list[Row]:
    """Bytes of one environment's state, every task, every engine."""
    rows = []
    for task in envs.names():
        for physics in ("mujoco", "mjx"):
            env = envs.load(task, physics=physics)
            size = state_bytes(jax.eval_shape(env.reset, jax.random.key(0)))
            note = f"{task}, {physics}"
            rows.append(Row(f"state_bytes_{task}_{physics}", size, "B", note))
    return rows


def plot(curves: Sequence[Curve], path: Path) -> None:
    """One panel a curve, both axes logarithmic."""
    figure, axes = plt.subplots(
        1, len(curves), figsize=(2.9 * len(curves), 2.8), layout="constrained"
    )
    for ax, curve in zip(axes, curves, strict=True):
        shown = [(s, t) for s, t in zip(curve.sizes, curve.times, strict=True) if s]
        sizes, times = np.array(shown).T
        ax.loglog(sizes, 1e6 * times, "o-", color="tab:blue", markersize=4)
        upper = slice(len(curve.sizes) // 2 - len(curve.sizes), None)
        power = sizes[upper] ** curve.exponent
        fit = power * np.exp(np.mean(np.log(times[upper] / power)))
        label = f"size$^{{{curve.exponent:.2f}}}$"
        ax.loglog(sizes[upper], 1e6 * fit, "--", color="tab:orange", label=label)
        ax.set(xlabel=curve.name, ylabel=f"{curve.unit} [us]")
        every = 2 if len(sizes) > 6 else 1
        ax.set_xticks(sizes[::-every], [f"{size:g}" for size in sizes[::-every]])
        ends = 1e6 * np.array([times.min(), times.max()])
        ax.set_yticks(ends, [f"{end:,.3g}" for end in ends])
        ax.minorticks_off()
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8)
    save_figure(figure, path, dpi=130)
    plt.close(figure)


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.scaling", description="How cost grows."
    )
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--plot", type=Path, help="draw the curves as a PNG")
    parser.add_argument("--quick", action="store_true", help="a smoke test: few sizes")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    """Measure, print, write and draw the requested files."""
    args = parse(argv)
    runtime.configure(compile_cache=False)
    seconds = 0.1 if args.quick else 2.0
    rows: list[Row] = state_rows()
    curves: list[Curve] = []
    sweeps: tuple[tuple[Callable[..., Curve], tuple[int, ...]], ...] = (
        (control_points, POINTS),
        (obstacles, OBSTACLES),
        (joints, JOINTS),
    )
    curve, memory = environments(
        ENVIRONMENTS[:3] if args.quick else ENVIRONMENTS, seconds
    )
    curves.append(curve)
    rows += [*curve.rows(), *memory]
    for sweep, sizes in sweeps:
        curves.append(sweep(sizes[:3] if args.quick else sizes, seconds))
        rows += curves[-1].rows()
    show(rows, "Scaling")
    if args.json:
        write_json(args.json, rows, quick=args.quick, batch=BATCH)
    if args.plot:
        plot(curves, args.plot)


if __name__ == "__main__":
    main()
