"""robosuite 1.5.2: door opening with a Jaco under OSC with variable stiffness.

Its defaults: 20 Hz, 25 physics steps of 2 ms, the controller at each of them. There are
no renderer, no cameras, and no resets in the measured time. robosuite steps one
environment per process, so one process per core runs in parallel, as its users would
do. The figure is the sum of their rates.
"""

from __future__ import annotations

import multiprocessing
import os
import warnings

from benchmarks.peers.worker import Measure, rate, serve

_measure: Measure | None = None


def _make() -> None:
    """One environment in this process, driven by uniform random actions."""
    global _measure
    import numpy as np
    import robosuite  # pyright: ignore[reportMissingImports]
    from robosuite.controllers import (  # pyright: ignore[reportMissingImports]
        load_composite_controller_config,
    )

    controller = load_composite_controller_config(controller="BASIC")
    controller["body_parts"]["right"]["impedance_mode"] = "variable_kp"
    env = robosuite.make(
        "Door",
        robots="Jaco",
        controller_configs=controller,
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        control_freq=20,
        reward_shaping=True,
        ignore_done=True,
    )
    env.reset()
    low, high = env.action_spec
    rng = np.random.default_rng(os.getpid())
    _measure = rate(lambda: env.step(rng.uniform(low, high)), 1)


def _run(seconds: float) -> float:
    assert _measure is not None
    return _measure(seconds)


def env_steps() -> Measure:
    """Environment steps a second on all cores."""
    cores = len(os.sched_getaffinity(0))
    # Each measurement fills its process for the same time: none gets two of them.
    pool = multiprocessing.get_context("spawn").Pool(cores, initializer=_make)
    pool.map(_run, [2.0] * cores, chunksize=1)  # started, and numba has compiled

    def measure(seconds: float) -> float:
        return sum(pool.map(_run, [seconds] * cores, chunksize=1))

    return measure


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    serve({"env_steps": env_steps}, ("robosuite", "mujoco", "numpy"))
