"""What the check of the inputs costs: each controller with it and without, in turns.

Run as ``python -m benchmarks.check_cost --json FILE``. Without the check a controller
says nothing of `usable`, and computes with whatever it is given.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import jax
import numpy as np

import rmp_mjx as rmp
from benchmarks.common import Row, show, write_json
from benchmarks.speed.bench_controller import BATCH, random_states
from rmp_mjx import runtime
from rmp_mjx.control.cbf import FilteredVICES
from rmp_mjx.control.controller import ImpedanceController
from rmp_mjx.robot.kinematics import arm_state

KINDS = {"rmp_vices": rmp.RMPVICES, "vices": rmp.VICES, "vices_cbf": FilteredVICES}
"""The controllers by name."""


def ratios(ctrl: ImpedanceController, batch: int, calls: int) -> np.ndarray:
    """Time with the check over time without it, call by call, (calls,).

    Args:
        ctrl: The controller.
        batch: States of a call.
        calls: Number of pairs of calls; who is first alternates.
    """
    q, qd, action, obstacles = random_states(ctrl.robot, batch, seed=0)
    setpoint = jax.vmap(ctrl.setpoint, in_axes=(0, 0, None))(q, action, 0.0)

    def checked(q, qd, setpoint, obstacles):
        return ctrl(q, qd, setpoint, obstacles).tau

    def trusting(q, qd, setpoint, obstacles):
        arm = arm_state(ctrl.robot, q, qd)
        return ctrl.unguarded(arm, setpoint, obstacles, None, None).tau

    compiled = [
        jax.jit(jax.vmap(torque, in_axes=(0, 0, 0, None)))
        .lower(q, qd, setpoint, obstacles)
        .compile()
        for torque in (checked, trusting)
    ]
    found = []
    for turn in range(calls + 10):
        spent = [0.0, 0.0]
        for side in (0, 1) if turn % 2 else (1, 0):
            start = time.perf_counter()
            jax.block_until_ready(compiled[side](q, qd, setpoint, obstacles))
            spent[side] = time.perf_counter() - start
        found.append(spent[0] / spent[1])
    return np.array(found[10:])  # the first ones make ready


def interval(values: np.ndarray, seed: int = 0) -> tuple[float, float]:
    """95 % of the bootstrap's medians lie between these."""
    rng = np.random.default_rng(seed)
    draws = rng.choice(values, (2000, len(values)))
    low, high = np.percentile(np.median(draws, axis=1), [2.5, 97.5])
    return float(low), float(high)


def main() -> None:
    """Measure, print, and write the requested file."""
    parser = argparse.ArgumentParser(description="Cost of the check of inputs.")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--calls", type=int, default=400, help="pairs of calls")
    args = parser.parse_args()
    runtime.configure(split_cpu=True, compile_cache=False)
    robot, rows = rmp.Robot.load("jaco2"), []
    for name, kind in KINDS.items():
        found = 100.0 * (ratios(kind(robot), BATCH, args.calls) - 1.0)
        low, high = interval(found)
        note = f"of {args.calls} pairs of calls; 95 % interval {low:.1f} to {high:.1f}"
        rows.append(Row(f"check_cost_{name}", float(np.median(found)), "%", note))
    show(rows, "Check of the inputs")
    if args.json:
        write_json(args.json, rows, batch=BATCH, robot="jaco2")


if __name__ == "__main__":
    main()
