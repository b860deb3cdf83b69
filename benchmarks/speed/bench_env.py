"""Speed of the trajectory task: policy steps a second on each physics engine.

Run as ``python -m benchmarks.bench_env --json FILE``.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import jax

import envs
from benchmarks.common import Row, measure, on_all_devices, show, write_json
from envs.arms import JACO
from rmp_mjx import runtime

ENGINES = ("mujoco", "mjx")
SIZES = (256, 1024, 2048)
WARM_UP = 10  # random policy steps before timing, so that the arms are moving


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(description="Environment speed.")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--quick", action="store_true", help="a smoke test: one size")
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of states and actions"
    )
    parser.add_argument(
        "--engine",
        choices=ENGINES,
        action="append",
        help="measure only this physics engine; may be repeated (default: all)",
    )
    parser.add_argument("--robot", default=JACO, help="arm, by name or path")
    parser.add_argument("--num_envs", type=int, nargs="+", default=SIZES)
    parser.add_argument(
        "--seconds", type=float, default=10.0, help="time for each size"
    )
    return parser.parse_args(argv)


def measure_engine(
    engine: str, robot: str, sizes: tuple[int, ...], seed: int, seconds: float
) -> list[Row]:
    """Rows of one engine.

    Args:
        engine: Physics engine.
        robot: Arm.
        sizes: Numbers of environments.
        seed: Of start states and actions.
        seconds: Time to spend on each size. [s]
    """
    env = envs.load("trajectory", controller="rmp_vices", physics=engine, robot=robot)
    reset = jax.jit(jax.vmap(env.reset))
    substeps = f"{env.n_substeps} x {env.sim_dt * 1e3:g} ms"
    rows = []
    for size in sizes:
        key_reset, key_action = jax.random.split(jax.random.key(seed))
        state = reset(jax.random.split(key_reset, size))
        actions = jax.random.uniform(
            key_action, (WARM_UP + 1, size, env.action_size), minval=-1.0, maxval=1.0
        )
        step = on_all_devices(env.step, size, (0, 0))
        start = time.perf_counter()
        compiled = jax.jit(step).lower(state, actions[0]).compile()
        compile_s = time.perf_counter() - start
        for action in actions[:-1]:
            state = jax.block_until_ready(compiled(state, action))
        timing = measure(step, state, actions[-1], seconds=seconds)
        rate = size / timing.median
        note = f"substeps {substeps}; {timing.spread}"
        rows.append(Row(f"env_steps_per_s_{engine}_{size}", rate, "1/s", note))
        physics = rate * env.n_substeps
        rows.append(Row(f"physics_steps_per_s_{engine}_{size}", physics, "1/s", note))
        if size == sizes[-1]:
            alone = controller_time(env, state, actions[-1], seconds)
            share = alone / timing.median
            note = f"{size} environments, no compile cache"
            rows.append(Row(f"compile_s_env_{engine}", compile_s, "s", note))
            note = f"{size} environments; controller timed alone"
            rows.append(Row(f"controller_share_of_step_{engine}", share, "", note))
    return rows


def controller_time(env, state, action, seconds: float) -> float:
    """Time of the controller's evaluations of one policy step alone [s]."""
    ctrl, n = env.controller, env.robot.n

    def torques(data, spheres, action):
        obstacles = env.obstacles(data, spheres)
        q, qd = data.qpos[:n], data.qvel[:n]
        setpoint = ctrl.setpoint(q, ctrl.decode(action), 0.0)

        def substep(qd, _):
            tau = ctrl(q, qd, setpoint, obstacles).tau
            # The next evaluation depends on this one, as it does behind physics.
            return qd + 1e-9 * tau, None

        return jax.lax.scan(substep, qd, None, length=env.n_substeps)[0]

    batched = on_all_devices(torques, len(action), (0, 0, 0))
    args = (state.data, state.info["spheres"], action)
    return measure(batched, *args, seconds=seconds).median


def main(argv: list[str] | None = None) -> None:
    """Measure, print, and write the requested files."""
    args = parse(argv)
    runtime.configure(split_cpu=True, compile_cache=False)
    sizes = (64,) if args.quick else tuple(args.num_envs)
    seconds = 1.0 if args.quick else args.seconds
    sizes_text = ", ".join(map(str, sizes))
    rows = []
    for engine in args.engine or ENGINES:
        rows += measure_engine(engine, args.robot, sizes, args.seed, seconds)
        if args.json:  # after each engine: nothing is lost if the next one is stopped
            write_json(
                args.json,
                rows,
                robot=args.robot,
                seed=args.seed,
                num_envs=sizes_text,
                quick=args.quick,
            )
    show(rows, "Trajectory task, RMP-VICES")


if __name__ == "__main__":
    main()
