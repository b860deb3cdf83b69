"""Hostile states: what every controller answers to inputs that mean nothing.

Run as ``python -m benchmarks.faults --json FILE``; exit code 1 if anything is wrong.
docs/fail_safe.md describes it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rmp_mjx as rmp
from benchmarks.common import Row, show, write_json
from benchmarks.studies.chains import random_chain
from rmp_mjx import runtime
from rmp_mjx.control.cbf import FilteredVICES
from rmp_mjx.control.controller import ImpedanceController
from rmp_mjx.control.vices import OSC
from rmp_mjx.robot.library import SHIPPED

WORST = (np.nan, np.inf, -np.inf, 3e38, -3e38)
LARGEST, LOOSE, LATEST = 1e4, 0.05, 1e9
SMALLEST = np.finfo(np.float32).tiny  # what is smaller is zero in a compiled program
FRAMES = ("R_des", "rotation", "normal", "axis")
SIGNLESS = ("kp_pos", "kp_ori", "radius", "half_length", "half_size")
SIGNLESS += ("attractor", "posture", "standoff")

Fields = dict[str, np.ndarray]
"""A batch of inputs by name; the first axis of each array counts the states."""


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


class Sampler:
    """Plausible inputs of an arm's controllers, as fields and as a tree."""

    def __init__(self, robot: rmp.Robot):
        """One state at home; the last slot of each kind is not in use."""
        self.robot, still = robot, jnp.zeros(robot.n)
        action = rmp.WeightedActionRange().decode(jnp.zeros(15))
        at, up = jnp.ones((2, 3)), jnp.eye(3)[2:]
        slots = rmp.Obstacles.empty(spheres=3, planes=2, capsules=2, boxes=2)
        one = {
            "q": jnp.asarray(robot.q_home, jnp.float32),
            "qd": still,
            "setpoint": rmp.VICES(robot).setpoint(still, action, jnp.float32(1.0)),
            "obstacles": slots.with_spheres(at, 0.1)
            .with_planes(-up, up)
            .with_capsules(-up, up, 0.1)
            .with_boxes(up, at[:1], None, 0.1),
            "tau_ext": still,
            "tau_last": still,
        }
        leaves, self._structure = jax.tree_util.tree_flatten_with_path(one)
        name = jax.tree_util.keystr
        self._home = {
            name(p, simple=True, separator="."): np.asarray(x) for p, x in leaves
        }

    def draw(self, rng: np.random.Generator, batch: int) -> Fields:
        """Inputs of so many states, all of which can be used."""
        fields = {k: np.repeat(x[None], batch, 0) for k, x in self._home.items()}
        for name in _numbers(fields):
            x = fields[name]
            if _last(name) in SIGNLESS:
                x *= rng.uniform(0.1, 1.0, x.shape)
            elif _last(name) not in FRAMES:
                x += 0.3 * rng.normal(size=x.shape)
        low, high = self.robot.q_lower, self.robot.q_upper
        fields["q"] = fields["q"].clip(low, high).astype(np.float32)
        return fields

    def tree(self, fields: Fields) -> dict[str, Any]:
        """The arguments of a controller's call."""
        return jax.tree.unflatten(self._structure, list(fields.values()))


def _numbers(fields: Fields) -> list[str]:
    return [name for name, x in fields.items() if x.dtype != bool]


def _last(name: str) -> str:
    return name.rpartition(".")[2]


def _active(fields: Fields, name: str) -> np.ndarray:
    return fields[name.rpartition(".")[0] + ".active"]


def _one_number(draw: Callable[..., np.ndarray]) -> Callable[..., None]:
    """A fault in one number of one field."""

    def fault(rng: np.random.Generator, fields: Fields, lanes: np.ndarray) -> None:
        names = _numbers(fields)
        which = rng.integers(len(names), size=len(lanes))
        for k, name in enumerate(names):
            own = np.flatnonzero(lanes & (which == k))
            flat = fields[name].reshape(len(lanes), -1)
            flat[own, rng.integers(flat.shape[1], size=len(own))] = draw(rng, len(own))

    return fault


def at_the_bounds(rng: np.random.Generator, fields: Fields, lanes: np.ndarray) -> None:
    """A fifth of all numbers as large as can be used."""
    for name in _numbers(fields):
        if _last(name) not in FRAMES:
            x = fields[name].reshape(len(lanes), -1)
            size = 10.0 ** rng.uniform(0.0, 4.0, x.shape)
            sign = 1.0 if _last(name) in SIGNLESS else rng.choice([-1.0, 1.0], x.shape)
            pick = lanes[:, None] & (rng.uniform(size=x.shape) < 0.2)
            x[pick] = (size * sign)[pick]


def unused(rng: np.random.Generator, fields: Fields, lanes: np.ndarray) -> None:
    """Anything at all in the slots that are not in use."""
    for name in _numbers(fields):
        if name.startswith("obstacles"):
            off = ~_active(fields, name) & lanes[:, None]
            fields[name][off] = rng.choice(WORST, fields[name][off].shape)


def meaningless(rng: np.random.Generator, fields: Fields, lanes: np.ndarray) -> None:
    """Finite numbers that mean nothing: no direction, no rotation, less than none."""
    names = [x for x in _numbers(fields) if _last(x) in FRAMES + SIGNLESS]
    which = rng.integers(len(names), size=len(lanes))
    for k, name in enumerate(names):
        own, x = lanes & (which == k), fields[name]
        if _last(name) in FRAMES:
            x[own] *= rng.choice([0.0, 2.0, -1.0], (own.sum(), *(1,) * (x.ndim - 1)))
        else:
            x[own] = -1.0 - x[own]


FAULTS: dict[str, Callable[..., None]] = {
    "plausible": lambda rng, fields, lanes: None,
    "any_size": _one_number(
        lambda rng, k: rng.choice([-1.0, 1.0], k) * 10.0 ** rng.uniform(-38, 38, k)
    ),
    "at_the_bounds": at_the_bounds,
    "not_finite": _one_number(lambda rng, k: rng.choice(WORST[:3], k)),
    "unused": unused,
    "meaningless": meaningless,
}
"""Families of states: what is written into those of a batch that a mask names."""

EXTREME = (FAULTS["any_size"], at_the_bounds)
"""Families with numbers up to the bounds, where float32 may find no solution."""


def usable(fields: Fields) -> tuple[np.ndarray, np.ndarray]:
    """Which states can be used by docs/fail_safe.md, and which are close to a bound."""
    good = np.ones(len(fields["q"]), bool)
    close = ~good
    for name in _numbers(fields):
        x, slots = fields[name].astype(float), name.startswith("obstacles")
        x = x.reshape(*x.shape[: 1 + slots], -1)
        x[np.abs(x) < SMALLEST] = 0.0
        fine = np.all(np.abs(x) <= (LATEST if _last(name) == "time" else LARGEST), -1)
        if _last(name) in SIGNLESS:
            fine &= np.all(x >= 0.0, axis=-1)
        error = np.zeros(fine.shape)
        if _last(name) in FRAMES:
            R = np.nan_to_num(x, nan=9.0).clip(-9.0, 9.0)
            R = R.reshape(*fine.shape, -1, 3)
            error = R @ R.swapaxes(-1, -2) - np.eye(R.shape[-2])
            error = np.abs(error).max((-1, -2))
            if R.shape[-2] == 3:
                error[np.linalg.det(R) < 0.0] = 9.0
        fine &= error <= LOOSE
        narrow = (error > 0.5 * LOOSE) & (error < 4.0 * LOOSE)
        if slots:
            use = _active(fields, name)
            fine, narrow = np.all(fine | ~use, axis=1), np.any(narrow & use, axis=1)
        good, close = good & fine, close | narrow
    return good, close


def attack(
    run: Callable[..., Any],
    sampler: Sampler,
    fault: Callable[..., None],
    rng: np.random.Generator,
    batch: int,
) -> dict[str, int]:
    """Give a batch to a compiled controller, plain and with faults in 3 of 4 states.

    Returns:
        The number of `unusable` states; of those `unsolved`, unusable though each input
        could be used, which only the families in `EXTREME` excuse; and of those where
        something is wrong: outputs `not_finite`; torques `over` the limits; a `flag`
        that is not what it should be, or `solved` where it is 0; torques that `changed`
        though no input in use did.
    """
    fields = sampler.draw(rng, batch)
    hostile = {name: x.copy() for name, x in fields.items()}
    lanes = rng.uniform(size=batch) < 0.75
    fault(rng, hostile, lanes)
    plain, out = (jax.device_get(run(sampler.tree(x))) for x in (fields, hostile))
    found = out.diagnostics
    # The clearance is infinite without an obstacle.
    shown = [out.tau, out.qdd, *(x for k, x in found.items() if k != "clearance")]
    finite = [np.isfinite(x.reshape(batch, -1)).all(1) for x in shown]
    good, close = usable(hostile)
    flag, solved = (found.get(k, 0.0 * good) > 0.0 for k in ("usable", "solved"))
    same = ~lanes | (fault is unused)
    limit = sampler.robot.tau_max.astype(np.float32)
    unsolved = good & ~close & ~flag & (fault in EXTREME)
    wrong = {
        "not_finite": ~np.all(finite, axis=0),
        "over": np.any(np.abs(out.tau) > limit, axis=1),
        "flag": ((flag != good) & ~close & ~unsolved) | (solved & ~flag),
        "changed": same & np.any(plain.tau != out.tau, axis=1),
    }
    counts = {"unusable": ~flag, "unsolved": unsolved} | wrong
    return {k: int(x.sum()) for k, x in counts.items()}


def compiled(ctrl: ImpedanceController) -> Callable[..., Any]:
    """A batch of inputs to outputs."""
    return jax.jit(jax.vmap(lambda given: ctrl(**given)))


def arms(seed: int) -> dict[str, rmp.Robot]:
    """Every arm that ships, and a random one."""
    shipped = {name: rmp.Robot.load(name) for name in SHIPPED}
    return shipped | {"random": random_chain(seed)}


def main() -> None:
    """Attack every controller of every arm, print, and write the requested file."""
    parser = argparse.ArgumentParser(description="Hostile states.")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--quick", action="store_true", help="a smoke test: few states")
    parser.add_argument("--seed", type=int, default=0, help="of the states and one arm")
    parser.add_argument(
        "--arm", action="append", choices=(*SHIPPED, "random"), help="only this arm"
    )
    args = parser.parse_args()
    runtime.configure()
    batch, batches, rows = *((256, 1) if args.quick else (2048, 9)), []
    made = arms(args.seed)
    for arm in args.arm or made:
        robot, rng = made[arm], np.random.default_rng(args.seed)
        sampler = Sampler(robot)
        for name, ctrl in controllers(robot).items():
            run, total, states = compiled(ctrl), dict[str, int](), 0
            for fault in [f for f in FAULTS.values() for _ in range(batches)]:
                found = attack(run, sampler, fault, rng, batch)
                total = {k: total.get(k, 0) + n for k, n in found.items()}
                states += batch
            note = ", ".join(
                f"{k} {n}" for k, n in ({"states": states} | total).items()
            )
            wrong = sum(n for k, n in total.items() if not k.startswith("un"))
            rows.append(Row(f"{arm}_{name}", wrong, "wrong states", note))
            print(rows[-1], flush=True)
        jax.clear_caches()
    show(rows, "Hostile states")
    if args.json:
        write_json(args.json, rows, batch=batch, batches=batches, seed=args.seed)
    sys.exit(any(row.value for row in rows))


if __name__ == "__main__":
    main()
