"""How well contact torque is observed: error and delay in scripted contacts.

`python -m benchmarks.observer --json FILE` presses the hand on the table, pulls the
door and pushes the block, and compares what observers say with the torque that MuJoCo
C's constraints exert in the same steps.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

import envs
from benchmarks.common import Row, markdown, show, write_json
from benchmarks.studies import experts
from envs.base import ArmEnv
from envs.types import State
from rmp_mjx import runtime
from rmp_mjx.control.observer import ContactMemory, ContactObserver
from rmp_mjx.sim import PhysicsState


def press(env: ArmEnv, state: State, memory: Any) -> tuple[Any, Array]:
    """Down onto the table for 2 s at the greatest stiffness, then up for 1 s."""
    up = jnp.where(state.info["step"] % 60 < 40, -0.3, 1.0)
    return memory, jnp.zeros(12).at[2].set(up).at[6:].set(1.0)


CONTACTS = {
    "table": experts.Case("trajectory", press, 180, {"controller": "vices"}),
    "handle": experts.Case("door", experts.pull, 120, {"variant": "vices"}),
    "block": experts.Case("push", experts.push, 240, {}),
}
"""Scripted contacts: VICES presses the hand on the table, RMP-VICES works."""

LARGEST_SHIFT = 20
"""Delays that are tried [control steps]."""


class Setting(NamedTuple):
    """An observer and what it measures."""

    gain: float | None
    """Bandwidth [1/s]; None for the one-step form."""
    noise: float = 0.0
    """Standard deviation of the velocities [rad/s]."""
    delay: int = 0
    """Control steps."""
    band: float = 0.0
    """Dead band [N m]."""

    @property
    def name(self) -> str:
        """The observer in words."""
        return "one-step" if self.gain is None else f"momentum, {self.gain:g}/s"


SETTINGS = (
    *(Setting(gain) for gain in (None, 200.0, 100.0, 50.0, 25.0)),
    Setting(None, delay=2),
    Setting(100.0, delay=2),
    *(Setting(gain, 0.001) for gain in (None, 100.0, 25.0)),
    *(Setting(gain, 0.01) for gain in (None, 100.0, 25.0)),
    Setting(100.0, 0.01, band=1.5),
)


class Trace(NamedTuple):
    """Every control step of some episodes, (steps, episodes, ...)."""

    measured: Any
    """Velocity, model and torque of the step."""
    acted: np.ndarray
    """Joint torque of the engine's constraints during the step [N m]."""
    dt: float
    """Control step [s]."""


def record(case: experts.Case, episodes: int, seed: int) -> Trace:
    """Run a script; the controller is told of the contacts by the one-step form."""
    options = {"physics": "mujoco", "terminate_on_event": False} | case.options
    env = envs.load(case.task, observer="exact", **options)

    def step(carry: tuple[State, Any], _: None) -> tuple[tuple[State, Any], Any]:
        state, memory = carry
        memory, action = case.act(env, state, memory)
        ctrl, spheres = env.controller, state.info["spheres"]
        q, time = state.data.qpos[: env.robot.n], env.dt * state.info["step"]
        setpoint = ctrl.setpoint(q, ctrl.decode(action), time)

        def substep(carry: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], Any]:
            data, known = carry
            out, known = env.control(data, spheres, setpoint, known)
            return (env.physics.step(data, out.tau), known), (data, known.contact)

        start = state.data, state.info["control"]
        rows = jax.lax.scan(substep, start, length=env.n_substeps)[1]
        return (env.step(state, action), memory), rows

    def episode(key: Array) -> tuple[PhysicsState, ContactMemory]:
        state = env.reset(key)
        start = state, experts.start(env, state)
        rows = jax.lax.scan(step, start, length=case.steps)[1]
        return jax.tree.map(jnp.concatenate, rows)

    keys = jax.random.split(jax.random.key(seed), episodes)
    before, measured = jax.jit(jax.vmap(episode, out_axes=1))(keys)
    before, measured = jax.tree.map(np.asarray, (before, measured))
    return Trace(measured, _acted(env, before, measured.tau), env.sim_dt)


def _acted(env: ArmEnv, before: Any, tau: np.ndarray) -> np.ndarray:
    """The constraints' joint torque in the step after each of these states."""
    data, acted = mujoco.MjData(env.scene.model), np.zeros(tau.shape)
    for row in np.ndindex(tau.shape[:2]):
        data.qpos[:], data.qvel[:] = before.qpos[row], before.qvel[row]
        data.qacc_warmstart[:] = before.warmstart[row]
        data.mocap_pos[:], data.ctrl[:] = before.mocap_pos[row], tau[row]
        mujoco.mj_step(env.scene.model, data)
        acted[row] = data.qfrc_constraint[: env.robot.n]
    return acted


def observe(robot: Any, trace: Trace, setting: Setting, seed: int) -> np.ndarray:
    """What an observer says before each step of a trace, (steps, episodes, n) [N m]."""
    observer = ContactObserver.of(robot, setting.gain, setting.band, setting.delay)
    noise = np.random.default_rng(seed).normal(size=trace.acted.shape)
    qd = trace.measured.qd + setting.noise * noise

    def step(memory: ContactMemory, row: Any) -> tuple[ContactMemory, Array]:
        qd, row = row
        out, memory = observer.estimate(memory, qd, trace.dt)
        return memory.then(row.Mq, row.bias, row.tau), out

    @jax.jit
    @lambda f: jax.vmap(f, in_axes=1, out_axes=1)
    def run(rows: Any) -> Array:
        return jax.lax.scan(step, observer.start(robot.n), rows)[1]

    return np.asarray(run((qd.astype(np.float32), trace.measured)))


def judge(trace: Trace, felt: np.ndarray) -> dict[str, float]:
    """How an observer does in a trace.

    Returns:
        `torque`, root mean square in contact [N m]; `delay`, the shift at which the
        estimate is nearest to the engine's torque [ms]; `shifted`, the error at that
        shift, relative to the torque; `median`, the error in contact of what the
        controller assumes for the step to come [N m]; and `false`, the 99th percentile
        of what is felt when nothing has touched for 0.3 s [N m].
    """
    steps = len(felt) - LARGEST_SHIFT
    late = felt[LARGEST_SHIFT:]
    errors = [
        np.sqrt(np.mean((late - trace.acted[LARGEST_SHIFT - s :][:steps]) ** 2))
        for s in range(LARGEST_SHIFT)
    ]
    size = np.linalg.norm(trace.acted, axis=-1)
    touching = size > 0.1
    # Free: nothing in the last 0.3 s, so that no estimate still decays.
    window = round(0.3 / trace.dt)
    recent = np.cumsum(size > 0.0, axis=0)
    free = recent[window:] == recent[:-window]
    false = np.linalg.norm(felt[window:][free], axis=-1)
    wrong = np.linalg.norm(felt - trace.acted, axis=-1)[touching]
    best = int(np.argmin(errors))
    return {
        "torque": float(np.sqrt(np.mean(size[touching] ** 2))),
        "delay": 1e3 * best * trace.dt,
        "shifted": float(errors[best] / np.sqrt(np.mean(trace.acted**2))),
        "median": float(np.median(wrong)),
        "false": float(np.percentile(false, 99)) if false.size else float("nan"),
    }


def study(episodes: int, seed: int) -> tuple[list[Row], str]:
    """Every setting in every contact: rows, and a Markdown table."""
    robot = envs.load("trajectory").robot
    traces = {name: record(case, episodes, seed) for name, case in CONTACTS.items()}
    rows, lines = [], []
    for setting in SETTINGS:
        found = {
            name: judge(trace, observe(robot, trace, setting, seed))
            for name, trace in traces.items()
        }
        key = f"gain={setting.gain}/noise={setting.noise:g}/delay={setting.delay}"
        key += f"/band={setting.band:g}"
        units = {"delay": "ms", "shifted": ""}
        rows += [
            Row(f"{key}/{name}/{what}", value, units.get(what, "N m"), setting.name)
            for name, figures in found.items()
            for what, value in figures.items()
        ]
        each = list(found.values())
        ms = round(1e3 * next(iter(traces.values())).dt * setting.delay)
        lines.append(
            (
                setting.name,
                f"{setting.noise:g}",
                f"{ms}",
                f"{setting.band:g}",
                " / ".join(f"{f['delay']:.0f}" for f in each),
                " / ".join(f"{100 * f['shifted']:.2g}" for f in each),
                " / ".join(f"{f['median']:.2f}" for f in each),
                f"{max(f['false'] for f in each):.2g}",
            )
        )
    head = (
        "form",
        "noise [rad/s]",
        "delay given [ms]",
        "dead band [N m]",
        "delay found [ms]",
        "error at that delay [%]",
        "error of the step to come, median [N m]",
        "felt without contact, 99 % [N m]",
    )
    return rows, markdown(head, lines)


def main(args: Sequence[str] | None = None) -> None:
    """Measure, print, and write the requested file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    options = parser.parse_args(args)
    runtime.configure()
    rows, table = study(options.episodes, options.seed)
    show(rows, "Contact torque")
    print(table)
    if options.json:
        write_json(options.json, rows, episodes=options.episodes, seed=options.seed)


if __name__ == "__main__":
    main()
