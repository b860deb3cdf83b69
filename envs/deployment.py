"""A trained policy with its controller as one file for a robot."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rmp_mjx.control.controller import ImpedanceController
from rmp_mjx.deploy import artefact
from rmp_mjx.deploy.card import card
from rmp_mjx.deploy.numpy_policy import WEIGHTS
from rmp_mjx.deploy.onnx_policy import to_onnx
from rmp_mjx.deploy.programs import control_programs, serialised
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.learning.networks import OBS_LIMIT, Agent
from rmp_mjx.training.policy import arrays_of, hidden_biases
from rmp_mjx.training.runs import run_folder

from .arms import JACO
from .base import ArmEnv
from .options import CTRL_DT
from .told import fixtures_program, observe_program


def controller_of(env: ArmEnv, period: float) -> ImpedanceController:
    """The task's controller at the period of a robot [s].

    Raises:
        ConfigError: It cannot be exported.
    """
    controller = env.controller
    if not isinstance(controller, ImpedanceController):
        raise ConfigError(
            f"'{type(controller).__name__}' cannot be exported: it is no "
            "ImpedanceController"
        )
    guard = controller.guard
    if guard is not None:
        if controller.robot.tau_rate_max is not None:
            raise ConfigError(
                "a guard's stop may change the torque at once, and "
                f"'{controller.robot.name}' limits its rate: export without guard"
            )
        guard = guard.replace(step=period)
    return controller.replace(period=period, guard=guard)


def plain(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of a policy as `NumpyPolicy` takes them."""
    found = {name: arrays[f"normalizer/{name}"] for name in ("mean", "std")}
    found["limit"] = np.asarray(OBS_LIMIT, np.float32)
    hidden = hidden_biases(arrays)
    last = [name for name in arrays if name.endswith("/bias") and name not in hidden]
    for i, name in enumerate([*hidden, *last]):
        found[f"W{i}"] = arrays[name.replace("/bias", "/kernel")]
        found[f"b{i}"] = arrays[name]
    return found


def export(
    file: Path,
    env: ArmEnv,
    agent: Agent,
    about: Mapping[str, Any],
    period: float,
    spheres: int,
) -> None:
    """Write the file.

    Args:
        file: The file, NAME.rmp.
        env: The task with the arm that the file is for.
        agent: The policy, acting with its mean.
        about: What the policy's file or run says of it.
        period: Time between two calls of the controller on the robot [s].
        spheres: Slots for spheres.

    Raises:
        ConfigError: The controller cannot be exported.
        ImportError: onnx is not installed.
    """
    controller = controller_of(env, period)
    guard = controller.guard
    slots = Obstacles.empty(spheres=spheres, planes=1, **env.fixture_slots)
    observer = None if env.observer is None else env.observer.replace(delay=0)
    programs = control_programs(controller, observer, slots)
    key = jax.random.key(0)  # the mean needs none

    def policy(observation):
        return agent(observation[None], key)[0]

    programs["policy"] = policy, (jnp.zeros(env.observation_size),)
    observe = observe_program(env, programs["control"][1][3])
    fixtures = fixtures_program(env)
    extra = {"observe": observe, "fixtures": fixtures}
    programs |= {name: program for name, program in extra.items() if program}
    arrays = plain(arrays_of(agent))
    metadata = {
        "task": env.name,
        "controller": env.options.controller,
        "guard": guard
        and {
            name: float(getattr(guard, name))
            for name in ("speed", "obstacle_speed", "obstacle_error")
        },
        "period": period,
        "policy_period": CTRL_DT,
        "observation": [list(entry) for entry in env.entries],
        "robot": _arm(env),
        "versions": run_folder.software(),
        "about": dict(about),
    }
    parts = {
        **serialised(programs),
        "policy.onnx": to_onnx(arrays),
        WEIGHTS: _npz(arrays),
        "card.md": card(metadata, about).encode(),
    }
    artefact.write(file, metadata, parts)


def _arm(env: ArmEnv) -> dict[str, Any]:
    """What a robot's computer must know of the arm; null is no limit."""
    robot, n = env.robot, env.robot.n

    def numbers(values: Any) -> list[float | None]:
        if values is None:
            return [None] * n
        return [float(x) if np.isfinite(x) else None for x in np.asarray(values)]

    own = env.options.robot == JACO
    return {
        "name": env.options.robot if env.options.robot != JACO else robot.name,
        "fingerprint": robot.fingerprint,
        "joints": list(robot.joint_names),
        "mount": [float(x) for x in env.mount],
        "tool": "Closed fingers."
        if own
        else "A rigid finger of 15 cm and 60 g at the flange.",
        "start": numbers(robot.q_home),
        **{
            name: numbers(getattr(robot, name))
            for name in ("q_lower", "q_upper", "qd_max", "tau_max", "tau_rate_max")
        },
    }


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)  # pyright: ignore[reportArgumentType]
    return stream.getvalue()
