"""Hostile states: what every controller answers to inputs that mean nothing.

Run as ``python -m benchmarks.faults --json FILE``. Exit code 1 if anything is wrong.
Each batch is made twice, plain and with faults in three of four states, and must give

* finite torques within the limits, in every state,
* `usable` as an independent reading of docs/fail_safe.md in NumPy says,
* where inputs in use did not change, the same torques bit by bit.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import rmp_mjx as rmp
from benchmarks.common import Row, show, write_json
from rmp_mjx import runtime
from rmp_mjx.control.cbf import FilteredVICES
from rmp_mjx.control.controller import ImpedanceController
from rmp_mjx.control.vices import OSC

BATCH, BATCHES = 2048, 10
SLOTS = {"spheres": 3, "planes": 2, "capsules": 2, "boxes": 2}
WORST = (np.nan, np.inf, -np.inf, 3e38, -3e38)
LARGEST, LOOSE, LATEST = 1e4, 0.05, 1e9

Fields = dict[str, np.ndarray]
"""A batch of inputs by name; the first axis of each array counts the states."""

Fault = Callable[[np.random.Generator, Fields, np.ndarray], None]
"""Writes faults into the states of a batch that the mask names."""


def controllers(robot: rmp.Robot) -> dict[str, ImpedanceController]:
    """Every controller there is, and two behind the guard."""
    guard = rmp.StopGuard.of(robot)
    return {
        "rmp_vices": rmp.RMPVICES(robot),
        "rmp_vices_literal": rmp.rmp_vices_literal(robot),
        "vices": rmp.VICES(robot),
        "osc": OSC(robot),
        "vices_cbf": FilteredVICES(robot),
        "rmp_vices_guarded": rmp.RMPVICES(robot, guard=guard),
        "vices_guarded": rmp.VICES(robot, guard=guard),
    }


def random_arm(seed: int, joints: int = 4) -> rmp.Robot:
    """A chain of capsules with random lengths and axes, one joint without limits."""
    rng = np.random.default_rng(seed)
    body, motors = '<site name="tip" pos="0 0 .1"/>', ""
    for j in reversed(range(joints)):
        axis = " ".join(f"{x:.3f}" for x in rng.normal(size=3))
        length, limits = rng.uniform(0.1, 0.3), 'range="-2 2"' if j else ""
        body = f"""<body pos="0 0 {length if j else 0.1}">
        <joint name="joint{j}" axis="{axis}" {limits} armature=".01"/>
        <geom type="capsule" fromto="0 0 0 0 0 {length}" size=".03"/>{body}</body>"""
        motors += f'<motor name="m{j}" joint="joint{j}" ctrlrange="-20 20"/>'
    return rmp.Robot.from_mjcf(
        f"""<mujoco><compiler angle="radian"/><worldbody>{body}</worldbody>
        <actuator>{motors}</actuator></mujoco>""",
        site="tip",
        spacing=0.05,
    )


class Sampler:
    """Plausible inputs of an arm's controllers, as a tree and as fields."""

    def __init__(self, robot: rmp.Robot):
        """Compile what makes set-points and obstacles."""
        self.robot = robot
        self._make = jax.jit(jax.vmap(self._one))

    def draw(self, rng: np.random.Generator, batch: int) -> Fields:
        """Inputs of so many states that every controller can use."""
        n = self.robot.n
        low = np.where(np.isfinite(self.robot.q_lower), self.robot.q_lower, -np.pi)
        high = np.where(np.isfinite(self.robot.q_upper), self.robot.q_upper, np.pi)
        q, qd = rng.uniform(low, high, (batch, n)), rng.normal(size=(batch, n))
        policy, noise = rng.uniform(-1, 1, (batch, 15)), rng.normal(size=(batch, 40))
        given = (np.asarray(x, np.float32) for x in (q, qd, policy, noise))
        leaves, self.structure = jax.tree_util.tree_flatten_with_path(
            jax.device_get(self._make(*given))
        )
        name = jax.tree_util.keystr
        return {name(p, simple=True, separator="."): np.array(x) for p, x in leaves}

    def tree(self, fields: Fields) -> dict[str, Any]:
        """The arguments of a controller's call, as a dict."""
        return jax.tree.unflatten(self.structure, list(fields.values()))

    def _one(self, q, qd, policy, noise):
        """Inputs of one state; one slot of each kind is not in use."""
        action = rmp.WeightedActionRange().decode(policy)
        x = jnp.array([[0.3, 0.0, 0.3]]) + 0.4 * noise[:24].reshape(8, 3)
        v = noise[24:33].reshape(3, 3)
        obstacles = (
            rmp.Obstacles.empty(**SLOTS)
            .with_spheres(x[:2], 0.05, v[:2], hand_may_touch=jnp.array([False, True]))
            .with_planes(
                jnp.array([[0.0, 0.0, -0.1]]), x[2:3] + jnp.array([[0.0, 0.0, 2.0]])
            )
            .with_capsules(x[3:4], x[4:5], 0.05, v[:1], v[1:2])
            .with_boxes(x[5:6], [[0.1, 0.2, 0.05]], None, 0.02, v[:1], v[2:])
        )
        return {
            "q": q,
            "qd": qd,
            "setpoint": rmp.VICES(self.robot).setpoint(q, action, jnp.float32(1.0)),
            "obstacles": obstacles,
            "tau_ext": policy[: self.robot.n],
            "tau_last": -policy[: self.robot.n],
        }


def _numbers(fields: Fields) -> list[str]:
    return [name for name, x in fields.items() if x.dtype != bool]


def _write(
    rng: np.random.Generator,
    fields: Fields,
    lanes: np.ndarray,
    value: Callable[[np.ndarray], np.ndarray],
) -> None:
    """Change one number of one field in each of these states."""
    names = _numbers(fields)
    which = rng.integers(len(names), size=len(lanes))
    for k, name in enumerate(names):
        own = np.flatnonzero(lanes & (which == k))
        flat = fields[name].reshape(len(lanes), -1)
        place = rng.integers(flat.shape[1], size=len(own))
        flat[own, place] = value(flat[own, place])


def beyond(rng: np.random.Generator, fields: Fields, lanes: np.ndarray) -> None:
    """One number of any size."""

    def value(x):
        size = 10.0 ** rng.uniform(-38, 38, x.shape)
        return (rng.choice([-1.0, 1.0], x.shape) * size).astype(x.dtype)

    _write(rng, fields, lanes, value)


def at_the_bounds(rng: np.random.Generator, fields: Fields, lanes: np.ndarray) -> None:
    """Many numbers as large as can be used."""
    for name in _numbers(fields):
        x = fields[name].reshape(len(lanes), -1)
        if name.rpartition(".")[2] in ("R_des", "rotation", "normal", "axis"):
            continue
        pick = lanes[:, None] & (rng.uniform(size=x.shape) < 0.2)
        size = 10.0 ** rng.uniform(0.0, 4.0, x.shape)
        signed = size * rng.choice([-1.0, 1.0], x.shape)
        positive = np.broadcast_to(_is_positive(name), x.shape)
        x[pick] = np.where(positive, size, signed)[pick]


def not_finite(rng: np.random.Generator, fields: Fields, lanes: np.ndarray) -> None:
    """One number that is none."""
    _write(rng, fields, lanes, lambda x: rng.choice(WORST[:3], x.shape))


def unused(rng: np.random.Generator, fields: Fields, lanes: np.ndarray) -> None:
    """Anything at all in the slots that are not in use."""
    for name in _numbers(fields):
        if name.startswith("obstacles"):
            off = ~fields[name.rpartition(".")[0] + ".active"] & lanes[:, None]
            x = fields[name]
            x[off] = rng.choice(WORST, x[off].shape)


def meaningless(rng: np.random.Generator, fields: Fields, lanes: np.ndarray) -> None:
    """Finite numbers that mean nothing: no direction, no rotation, less than none."""
    names = [x for x in _numbers(fields) if _is_frame(x) or _is_positive(x)]
    which = rng.integers(len(names), size=len(lanes))
    for k, name in enumerate(names):
        own = lanes & (which == k)
        factors = (0.0, 2.0, -1.0) if _is_frame(name) else (-1.0,)
        x, shape = fields[name], (int(own.sum()), *(1,) * (fields[name].ndim - 1))
        x[own] = (x[own] + (not _is_frame(name))) * rng.choice(factors, shape)


FAULTS: dict[str, Fault] = {
    "plausible": lambda rng, fields, lanes: None,
    "beyond": beyond,
    "at_the_bounds": at_the_bounds,
    "not_finite": not_finite,
    "unused": unused,
    "meaningless": meaningless,
}
"""Families of hostile states by name."""


def _is_frame(name: str) -> bool:
    return name.rpartition(".")[2] in ("R_des", "rotation", "normal", "axis")


def _is_positive(name: str) -> bool:
    signless = ("kp_pos", "kp_ori", "radius", "half_length", "half_size")
    return name.rpartition(".")[2] in signless or ".weights." in name


def usable(fields: Fields) -> tuple[np.ndarray, np.ndarray]:
    """What docs/fail_safe.md says of a batch, in float64.

    Returns:
        Which states can be used, and which are too close to call.
    """
    good, close = np.ones((2, len(fields["q"])), bool)
    close[:] = False
    for name in _numbers(fields):
        x = fields[name].astype(np.float64)
        x = x.reshape(*x.shape[: 2 if name.startswith("obstacles") else 1], -1)
        limit = LATEST if name.endswith(".time") else LARGEST
        fine = np.all(np.abs(x) <= limit, axis=-1)
        if _is_positive(name):
            fine &= np.all(x >= 0.0, axis=-1)
        narrow = np.zeros_like(fine)
        if _is_frame(name):
            with np.errstate(all="ignore"):
                error = _frame_error(x)
            narrow = (error > 0.5 * LOOSE) & (error < 4.0 * LOOSE)
            fine &= error <= LOOSE
        if name.startswith("obstacles"):
            active = fields[name.rpartition(".")[0] + ".active"]
            fine, narrow = np.all(fine | ~active, axis=1), np.any(narrow & active, 1)
        good &= fine
        close |= narrow
    return good, close


def _frame_error(x: np.ndarray) -> np.ndarray:
    """How far vectors (..., 3) or rotations (..., 9) are from orthonormal."""
    if x.shape[-1] == 3:
        error = np.abs(np.sum(x * x, axis=-1) - 1.0)
    else:
        R = np.nan_to_num(x, nan=9.0, posinf=9.0, neginf=9.0).clip(-9, 9)
        R = R.reshape(*x.shape[:-1], 3, 3)
        error = np.abs(R @ R.swapaxes(-1, -2) - np.eye(3)).max((-1, -2))
        error = np.where(np.linalg.det(R) < 0.0, 9.0, error)
    return np.where(np.isfinite(error), error, 9.0)


class Count(NamedTuple):
    """What was wrong in so many states."""

    states: int
    """States that were tried."""
    unusable: int
    """Those whose inputs cannot be used."""
    not_finite: int
    """Torques, accelerations or diagnostics that are not finite."""
    over_the_limits: int
    """Torques beyond the motors'."""
    wrong_flag: int
    """`usable` is not what it should be, or `solved` where it is 0."""
    changed: int
    """Other torques though no input in use is another."""

    @property
    def wrong(self) -> int:
        """All that should be zero."""
        return sum(self[2:])


def attack(
    run: Callable[..., Any],
    sampler: Sampler,
    fault: Fault,
    rng: np.random.Generator,
    batch: int,
) -> Count:
    """Give one batch of hostile states to a compiled controller.

    Args:
        run: A batch of inputs, as `Sampler.tree` gives them, to outputs.
        sampler: Draws the plausible states.
        fault: Makes three of four hostile.
        rng: Random numbers.
        batch: Number of states.
    """
    fields = sampler.draw(rng, batch)
    hostile = {name: x.copy() for name, x in fields.items()}
    lanes = rng.uniform(size=batch) < 0.75
    fault(rng, hostile, lanes)
    plain, out = (jax.device_get(run(sampler.tree(x))) for x in (fields, hostile))
    found = dict(out.diagnostics)
    finite = np.isfinite(out.tau).all(1) & np.isfinite(out.qdd).all(1)
    for name, x in found.items():
        if name != "clearance":  # infinite without an obstacle
            finite &= np.isfinite(x.reshape(batch, -1)).all(1)
    good, close = usable(hostile)
    flag = found["usable"] > 0.0
    claims = ~flag & (found.get("solved", np.zeros(batch)) > 0.0)
    same = ~lanes | (fault is unused)
    moved = np.any(plain.tau.view(np.uint32) != out.tau.view(np.uint32), axis=1)
    limit = sampler.robot.tau_max.astype(np.float32)
    return Count(
        batch,
        int(np.sum(~flag)),
        int(np.sum(~finite)),
        int(np.sum(np.any(np.abs(out.tau) > limit, axis=1))),
        int(np.sum((flag != good) & ~close | claims)),
        int(np.sum(moved & same)),
    )


def compiled(ctrl: ImpedanceController, **options: Any) -> Callable[..., Any]:
    """A batch of inputs to outputs, jitted with these options."""
    return jax.jit(jax.vmap(lambda given: ctrl(**given)), **options)


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(description="Hostile states.")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--quick", action="store_true", help="a smoke test: few states")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random states")
    parser.add_argument("--arm", type=int, default=0, help="seed of the random arm")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    """Attack every controller of two arms, print, and write the requested file."""
    args = parse(argv)
    runtime.configure()
    batch, batches = (256, 1) if args.quick else (BATCH, BATCHES)
    rng, rows, wrong = np.random.default_rng(args.seed), [], 0
    for arm, robot in (
        ("jaco2", rmp.Robot.load("jaco2")),
        ("random", random_arm(args.arm)),
    ):
        sampler = Sampler(robot)
        for name, ctrl in controllers(robot).items():
            run = compiled(ctrl)
            for family, fault in FAULTS.items():
                several = [
                    attack(run, sampler, fault, rng, batch) for _ in range(batches)
                ]
                count = Count(*np.sum(several, axis=0).tolist())
                note = ", ".join(f"{k} {v:,}" for k, v in count._asdict().items())
                rows.append(Row(f"{arm}_{name}_{family}", count.wrong, "wrong", note))
                wrong += count.wrong
                print(f"{arm} {name} {family}: {note}", flush=True)
    show(rows, "Hostile states")
    if args.json:
        write_json(args.json, rows, batch=batch, batches=batches, **vars_of(args))
    sys.exit(1 if wrong else 0)


def vars_of(args: argparse.Namespace) -> dict[str, Any]:
    """The options that a result depends on."""
    return {"seed": args.seed, "arm": args.arm, "quick": args.quick}


if __name__ == "__main__":
    main()
