"""Replay a step that became non-finite, in MuJoCo C, one physics step at a time.

`python -m envs.replay RUN` takes the first such step of a run, RUN/nonfinite/NAME.npz
another one. It reads what training wrote (state before the step, action, key), goes
through the policy step, and names the first quantity that is not finite or beyond its
limit.
"""

from __future__ import annotations

import argparse
import copy
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

from rmp_mjx import runtime
from rmp_mjx.fields import arguments
from rmp_mjx.training.learning import faults
from rmp_mjx.training.learning.rollout import VALUE_LIMIT
from rmp_mjx.training.runs import run_folder
from rmp_mjx.trees import named_leaves

from . import registry
from .base import ArmEnv
from .flags import from_record
from .types import State

SPEED_LIMIT = 1e3
"""Joint speeds beyond this count as bad; so they do in the tasks [rad/s]."""
WATCHED = ("torque", "acceleration", "speed")
"""Columns of the table: their greatest magnitudes in each physics step."""


class Moment(NamedTuple):
    """Quantities at one place of the policy step, in the order of their computation."""

    place: str
    """Where in the step."""
    values: Mapping[str, np.ndarray]
    """Quantities by name."""


class Finding(NamedTuple):
    """The first bad number."""

    place: str
    """Where in the step."""
    name: str
    """Quantity and entry."""
    value: float
    """What it was."""


def policy_step(env: ArmEnv, state: State, action: np.ndarray) -> Iterator[Moment]:
    """Go through a policy step as `ArmEnv.step` does, physics by MuJoCo itself.

    Args:
        env: The task, with any engine.
        state: State before the step.
        action: The policy's action.

    Yields:
        The start, the set-point, the parts of every physics step, and the result.
    """
    options, n, info = env.options, env.robot.n, state.info
    data, spheres, memory = state.data, info["spheres"], info["control"]
    yield Moment("before", {"action": np.asarray(action), **_motion(data)})

    ctrl = env.controller
    setpoint = jax.jit(lambda q, a, time: ctrl.setpoint(q, ctrl.decode(a), time))(
        data.qpos[:n], jnp.asarray(action), env.dt * info["step"]
    )
    target = named_leaves(setpoint).items()
    yield Moment("set-point", {k.lstrip("."): np.asarray(v) for k, v in target})

    _, key = jax.random.split(info["rng"])
    error = env.sphere_error(key)
    noise = env.noise(jax.random.fold_in(key, 1))

    @jax.jit
    def control(data, spheres, memory, noise):
        out, memory = env.control(data, spheres, setpoint, memory, error, noise)
        centers = data.mocap_pos
        if options.obstacle_speed and env.scene.spheres:
            centers, spheres = spheres.move(centers, env.sim_dt, *env.sphere_box)
        return out, memory.acting(out.tau), centers, spheres, memory

    model = copy.copy(env.scene.model)
    for name, value in data.model.items():
        getattr(model, name)[:] = value
    simulated = mujoco.MjData(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    for k in range(env.n_substeps):
        wrong = None if noise is None else jax.tree.map(lambda x, k=k: x[k], noise)
        out, acting, centers, spheres, memory = control(data, spheres, memory, wrong)
        parts = {
            "root force": np.asarray(out.f),
            "root metric": np.asarray(out.M),
            "desired acceleration": np.asarray(out.qdd),
            "torque": np.asarray(acting),
        }
        yield Moment(f"controller, physics step {k + 1}", parts)
        simulated.qpos[:], simulated.qvel[:] = data.qpos, data.qvel
        simulated.qacc_warmstart[:] = data.warmstart
        simulated.mocap_pos[:] = centers
        simulated.ctrl[:] = acting
        mujoco.mj_step(model, simulated)
        data = data.replace(
            qpos=jnp.asarray(simulated.qpos, data.qpos.dtype),
            qvel=jnp.asarray(simulated.qvel, data.qvel.dtype),
            warmstart=jnp.asarray(simulated.qacc_warmstart, data.qpos.dtype),
            sensors=jnp.asarray(simulated.sensordata, data.qpos.dtype),
            mocap_pos=centers,
        )
        parts = {"acceleration": simulated.qacc.copy(), **_motion(data)}
        parts["contact sensors"] = np.asarray(data.sensors)
        yield Moment(f"physics, physics step {k + 1}", parts)

    new = jax.jit(env.step)(state, jnp.asarray(action))
    result = {"observation": np.asarray(new.obs), "reward": np.asarray(new.reward)}
    yield Moment("result", result)


def _motion(data: Any) -> dict[str, np.ndarray]:
    return {"position": np.asarray(data.qpos), "speed": np.asarray(data.qvel)}


def first_bad(
    moments: Iterator[Moment], limit: float, seen: list[Moment] | None = None
) -> Finding | None:
    """The first quantity that is not finite or beyond its limit; None: all are good.

    Args:
        moments: Of a policy step; not read beyond the finding.
        limit: Greatest magnitude; `SPEED_LIMIT` for speeds. The root's force and metric
            have none.
        seen: Gets the moments that were read.
    """
    limits = {"speed": SPEED_LIMIT, "root force": np.inf, "root metric": np.inf}
    for moment in moments:
        if seen is not None:
            seen.append(moment)
        for name, value in moment.values.items():
            flat = np.ravel(value)
            good = np.isfinite(flat) & (np.abs(flat) <= limits.get(name, limit))
            if not good.all():
                entry = int(np.argmin(good))
                return Finding(moment.place, f"{name}[{entry}]", float(flat[entry]))
    return None


def choose(path: Path) -> Path:
    """The file itself, or the earliest one in the folder of a run.

    Raises:
        ValueError: The run has none.
    """
    if not path.is_dir():
        return path
    files = sorted((path / run_folder.NONFINITE).glob("*.npz"))
    if not files:
        raise ValueError(f"{path} has no non-finite steps in {run_folder.NONFINITE}/")
    return min(files, key=lambda file: faults.about(file)["iteration"])


def read(path: Path) -> tuple[ArmEnv, State, np.ndarray, dict[str, Any]]:
    """The task, state, action and origin in a file.

    Raises:
        ValueError: It is no such file, or of another task.
    """
    about = faults.about(path)
    config = from_record(about["config"])
    env = registry.make(config.replace(physics="mujoco").task)
    template = jax.eval_shape(env.reset, jax.random.key(0))
    state, action = faults.load(path, template)
    return env, state, action, about


def main(args: Sequence[str] | None = None) -> int:
    """Replay a file, print a table and the finding; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dump", type=Path, help="RUN or RUN/nonfinite/NAME.npz")
    parser.add_argument(
        "--limit", type=float, default=VALUE_LIMIT, help="greatest good magnitude"
    )
    parser.add_argument("--env", help="the run's task, if it is a module:Class")
    say = partial(Console().print, markup=False, highlight=False, soft_wrap=True)
    try:
        options = parser.parse_args(arguments(args))
        if not options.limit > 0:
            raise ValueError(f"limit must be positive, is {options.limit}")
        if options.env:
            registry.task(options.env)
        runtime.configure()
        env, state, action, about = read(choose(options.dump))
    except (ValueError, OSError) as error:
        Console(stderr=True).print(f"error: {error}", markup=False, soft_wrap=True)
        return 2
    moments: list[Moment] = []
    found = first_bad(policy_step(env, state, action), options.limit, moments)
    where = ", ".join(f"{k} {about[k]}" for k in faults.PLACE)
    table = Table(title=f"{env.name}, {where}")
    table.add_column("greatest magnitude")
    for name in WATCHED:
        table.add_column(name, justify="right")
    for moment in moments:
        values = (moment.values.get(name) for name in WATCHED)
        cells = ("" if v is None else f"{np.max(np.abs(v)):.3g}" for v in values)
        table.add_row(moment.place, *cells)
    Console().print(table)
    if found:
        say(f"first bad number: {found.name} = {found.value:g}, {found.place}")
    else:
        say("every number is finite and within its limit in MuJoCo C")
    return 0


if __name__ == "__main__":
    sys.exit(main())
