"""Speed of the controller alone: batched throughput, latency, compile time.

Run as ``python -m benchmarks.bench_controller --json FILE``.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import rmp_mjx as rmp
from benchmarks.common import (
    AutodiffRMPVICES,
    Row,
    measure,
    measure_calls,
    on_all_devices,
    rows_with_default_flags,
    show,
    write_json,
)
from envs.arms import JACO
from rmp_mjx import runtime

SPHERES = 5
BATCH = 2048


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(description="Controller speed.")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--quick", action="store_true", help="a smoke test: few calls")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random states")
    parser.add_argument("--robot", default=JACO, help="arm, by name or path")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args(argv)


def random_states(robot: rmp.Robot, batch: int, seed: int):
    """Joint states inside the limits, slow set-point changes, spheres in reach.

    Returns:
        q, qd (batch, n); one Action per state; Obstacles shared by all.
    """
    rng = np.random.default_rng(seed)
    low = np.where(np.isfinite(robot.q_lower), robot.q_lower, -np.pi)
    high = np.where(np.isfinite(robot.q_upper), robot.q_upper, np.pi)
    centre, half = (low + high) / 2, (high - low) / 2
    q = centre + 0.9 * half * rng.uniform(-1, 1, (batch, robot.n))
    qd = 0.5 * rng.standard_normal((batch, robot.n))
    action = rmp.Action(
        dpos=jnp.asarray(rng.uniform(-0.05, 0.05, (batch, 3)), jnp.float32),
        drot=jnp.asarray(rng.uniform(-0.2, 0.2, (batch, 3)), jnp.float32),
        kp_pos=jnp.asarray(rng.uniform(10, 300, (batch, 3)), jnp.float32),
        kp_ori=jnp.asarray(rng.uniform(10, 300, (batch, 3)), jnp.float32),
    )
    angle = rng.uniform(-np.pi, np.pi, SPHERES)
    centers = np.stack(
        [0.5 * np.cos(angle), 0.5 * np.sin(angle), rng.uniform(0, 0.6, SPHERES)], 1
    )
    obstacles = rmp.Obstacles.empty(spheres=SPHERES).with_spheres(
        jnp.asarray(centers, jnp.float32), jnp.full(SPHERES, 0.05)
    )
    return (
        jnp.asarray(q, jnp.float32),
        jnp.asarray(qd, jnp.float32),
        action,
        obstacles,
    )


class InContact(rmp.RMPVICES):
    """RMP-VICES with a joint torque of contacts at every call."""

    def __call__(self, q, qd, setpoint, obstacles, tau_ext=None, tau_last=None):
        """Torque for one state."""
        felt = 5.0 * jnp.sin(q) if tau_ext is None else tau_ext  # some torque [N m]
        return super().__call__(q, qd, setpoint, obstacles, felt, tau_last)


def throughput(
    ctrl: rmp.RMPVICES | rmp.VICES, batch: int, seed: int, seconds: float
) -> tuple[Row, ...]:
    """Evaluations a second of a batch sharing its obstacles, and the compile time."""
    q, qd, action, obstacles = random_states(ctrl.robot, batch, seed)
    setpoint = jax.jit(jax.vmap(ctrl.setpoint, in_axes=(0, 0, None)))(q, action, 0.0)

    def torque(q, qd, setpoint, obstacles):
        return ctrl(q, qd, setpoint, obstacles).tau

    args, axes = (q, qd, setpoint, obstacles), (0, 0, 0, None)
    one = measure(jax.vmap(torque, in_axes=axes), *args, seconds=seconds)
    every = measure(on_all_devices(torque, batch, axes), *args, seconds=seconds)
    cores = f"on {jax.local_device_count()} devices; {every.spread}"
    name = f"evals_per_s_batch{batch}"
    return (
        Row(name, batch / one.median, "1/s", one.spread),
        Row(f"{name}_all_devices", batch / every.median, "1/s", cores),
        Row("compile_s", one.compile_s, "s", f"batch {batch}, no compile cache"),
    )


def latency(ctrl: rmp.RMPVICES | rmp.VICES, seed: int, calls: int) -> list[Row]:
    """Median and 99th percentile of single jitted calls."""
    q, qd, action, obstacles = random_states(ctrl.robot, 1, seed)
    q, qd, action = jax.tree.map(lambda x: x[0], (q, qd, action))
    setpoint = ctrl.setpoint(q, action, 0.0)

    def torque(q, qd, setpoint, obstacles):
        return ctrl(q, qd, setpoint, obstacles).tau

    times = measure_calls(torque, q, qd, setpoint, obstacles, calls=calls) * 1e6
    return [
        Row(f"latency_us_p{p}_batch1", float(np.percentile(times, p)), "us", note)
        for p, note in ((50, f"{calls} calls"), (99, f"{calls} calls"))
    ]


def measure_all(
    name: str, quick: bool, seed: int, *, autodiff: bool = True
) -> list[Row]:
    """Every row of one process, for the arm of this name."""
    robot = rmp.Robot.load(name)
    batch, seconds, calls = (256, 0.5, 200) if quick else (BATCH, 10.0, 20_000)
    guard = rmp.StopGuard.of(robot)
    named = [
        ("controller", "", rmp.RMPVICES(robot)),
        ("vices", "", rmp.VICES(robot)),
        ("controller", "_in_contact", InContact(robot)),
        ("controller", "_guarded", rmp.RMPVICES(robot, guard=guard)),
    ]
    if autodiff:
        named.append(("controller", "_autodiff", AutodiffRMPVICES(robot)))
    rows = []
    for name, suffix, ctrl in named:
        single = latency(ctrl, seed, calls)
        for row in (*throughput(ctrl, batch, seed, seconds), *single):
            note = row.note
            if name == "controller":
                points = len(robot.control_points)
                note = f"{points} points x {SPHERES} spheres; {note}"
            key = f"{name}_{row.key}"
            if row.key == "compile_s":
                key = f"compile_s_{name}"
            rows.append(Row(key + suffix, row.value, row.unit, note))
    return rows


def main(argv: list[str] | None = None) -> None:
    """Measure, print, and write the requested files."""
    args = parse(argv)
    runtime.configure(cpu_flags=not args.worker, split_cpu=True, compile_cache=False)
    rows = measure_all(args.robot, args.quick, args.seed, autodiff=not args.worker)
    if args.worker:
        print(json.dumps([asdict(row) for row in rows]))
        return
    options = ["--robot", args.robot, "--seed", str(args.seed)]
    options += ["--quick"] * args.quick
    rows += rows_with_default_flags("benchmarks.speed.bench_controller", options)
    show(rows, "Controller")
    if args.json:
        sizes = {"robot": args.robot, "spheres": SPHERES, "quick": args.quick}
        write_json(args.json, rows, seed=args.seed, **sizes)


if __name__ == "__main__":
    main()
