"""How small the physics and control timestep must be, and how good the solver is.

Run as ``python -m benchmarks.timestep --json FILE [--plot FILE]``. Every timestep gets
the same starts and the same policy actions at 20 Hz, on MuJoCo's C engine; the paths
are compared with those of the finest timestep.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import mujoco
import numpy as np

import envs
from benchmarks.common import Row, show, write_json
from benchmarks.png import save_figure
from envs.safety import Motion, Torques, observe
from rmp_mjx import runtime
from rmp_mjx.robot.kinematics import site_pose
from rmp_mjx.sim import PhysicsState, load_physics, read_contacts

TIMESTEPS = (1e-3, 2e-3, 2.5e-3, 5e-3, 1e-2)
CONTROLLERS = ("rmp_vices", "vices")
INTEGRATORS = ("implicitfast", "implicit", "Euler", "RK4")
STEPS = 100  # policy steps, 5 s
REPORT = (20, 100)  # after 1 s and 5 s


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(description="Timestep and solver convergence.")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--plot", type=Path, help="draw the path errors to this file")
    parser.add_argument(
        "--num-envs", type=int, default=128, help="number of random episodes"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of starts and actions"
    )
    parser.add_argument("--quick", action="store_true", help="a smoke test")
    return parser.parse_args(argv)


def smooth_actions(rng: np.random.Generator, steps: int, size: int) -> np.ndarray:
    """Ornstein-Uhlenbeck actions, unit variance, 0.5 s correlation, clipped.

    Returns:
        (steps, size, 12) in [-1, 1].
    """
    keep = np.exp(-0.05 / 0.5)
    x = rng.standard_normal((size, 12))
    rows = []
    for _ in range(steps):
        rows.append(x)
        x = keep * x + np.sqrt(1 - keep**2) * rng.standard_normal((size, 12))
    return np.clip(rows, -1.0, 1.0).astype(np.float32)


class Study:
    """The same random episodes for every variant of the physics."""

    def __init__(self, size: int, seed: int):
        """Draw starts, spheres and actions once."""
        env = envs.load("trajectory", physics="mujoco", obstacles=2)
        keys = jax.random.split(jax.random.key(seed), size)
        self.starts = jax.jit(jax.vmap(env.reset))(keys)
        self.actions = smooth_actions(np.random.default_rng(seed), STEPS, size)
        self.contacts: PhysicsState | None = None
        self.torques: Any = None

    def run(self, controller: str, dt: float, integrator: str = "implicitfast"):
        """Roll all episodes out.

        Returns:
            Dict of arrays: `path` (steps, envs, 3) [m]; per step and episode `event`,
            `force` [N] (greatest of the pairs) and `jump` [N m], the greatest change of
            a torque between two physics steps with one set-point; and the last step's
            `state` and `tau`.
        """
        env = envs.load(
            "trajectory",
            controller=controller,
            physics="mujoco",
            obstacles=2,
            sim_dt=dt,
        )
        kind = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
        env.scene.model.opt.integrator = kind
        rolled = jax.jit(lambda s, a: _roll_out(env, s, a))(self.starts, self.actions)
        rolled = jax.tree.map(np.asarray, rolled)
        # NaN never compares as an event; an exploded episode counts as one for ever.
        bad = ~np.isfinite(rolled["path"]).all(-1)
        return rolled | {"event": rolled["event"] | bad}


def _roll_out(env, starts, actions) -> dict[str, Any]:
    ctrl, n = env.controller, env.robot.n

    def policy_step(data, inputs):
        action, spheres = inputs
        setpoint = ctrl.setpoint(data.qpos[:n], ctrl.decode(action), 0.0)  # no dither
        obstacles = env.obstacles(data, spheres)

        def substep(carry, _):
            data, torques, event, force, jump = carry
            out = ctrl(data.qpos[:n], data.qvel[:n], setpoint, obstacles)
            after = env.physics.step(data, out.tau)
            torques = torques.then(out.tau)
            limit = out.diagnostics["torque_limit"]
            motion = Motion.start(after.qvel[:n])  # its jerk is not used
            now = observe(env.scene, env.robot, after, torques, motion, limit)
            jump = jnp.maximum(jump, now.torque_jump)
            force = jnp.maximum(force, now.contact_force_peak)
            return (after, torques, event | now.event, force, jump), None

        nothing = jnp.zeros((), bool), jnp.zeros(()), jnp.zeros(())
        start = (data, Torques.start(n), *nothing)
        (after, torques, event, force, jump), _ = jax.lax.scan(
            substep, start, None, length=env.n_substeps
        )
        row = {
            "path": site_pose(env.robot, after.qpos)[0],
            "event": event,
            "force": force,
            "jump": jump,
            "state": after,
            "tau": torques.tau,
        }
        return after, row

    def step(data, action):
        return jax.vmap(policy_step)(data, (action, starts.info["spheres"]))

    return jax.lax.scan(step, starts.data, actions)[1]


def compare(name: str, mine: dict, best: dict, note: str) -> list[Row]:
    """Rows of one variant against the reference.

    Paths are compared until an episode's first event in either run. After a collision
    they measure how chaotic an impact is, not how good the timestep is.
    """
    rows = []
    touched = mine["event"] | best["event"]
    for steps in REPORT:
        clean = ~touched[:steps].any(axis=0)
        error = np.linalg.norm(
            mine["path"][steps - 1] - best["path"][steps - 1], axis=-1
        )
        error = error[clean] * 1e3
        text = f"{note}; {clean.sum()} episodes without event"
        seconds = f"{steps * 0.05:g}s"
        if mine is not best and len(error):
            for label, q in (("median", 50), ("p95", 95)):
                value = float(np.percentile(error, q))
                rows.append(
                    Row(f"path_error_{seconds}_{label}_{name}", value, "mm", text)
                )
    onset = mine["event"] & ~np.vstack(
        [np.zeros_like(mine["event"][:1]), mine["event"][:-1]]
    )
    total = mine["event"].size
    rate = 1e3 * onset.sum() / total
    rows.append(
        Row(f"events_per_1000_{name}", rate, "", f"{note}; {total} policy steps")
    )
    quiet = mine["jump"][~mine["event"]]
    for label, q in (("p99", 99), ("max", 100)):
        value = float(np.percentile(quiet, q))
        rows.append(Row(f"torque_jump_{label}_{name}", value, "N m", note))
    return rows


def solver_rows(rolled: dict, size: int) -> list[Row]:
    """Contact force of one step against 100 iterations in C, from states in contact.

    Args:
        rolled: A run with collisions.
        size: Number of states to take.
    """
    env = envs.load("trajectory", physics="mujoco", obstacles=2)
    model = env.scene.model
    # A step from a state that follows contact, with the torque that led there.
    busy = np.argwhere((rolled["force"] > 1.0) & np.isfinite(rolled["tau"]).all(-1))
    chosen = busy[np.linspace(0, len(busy) - 1, size).astype(int)]
    at, lane = chosen.T
    state = jax.tree.map(lambda x: jnp.asarray(x[at, lane]), rolled["state"])
    tau = jnp.asarray(rolled["tau"][at, lane])

    def force(engine: str, iterations: int) -> np.ndarray:
        model.opt.iterations, model.opt.ls_iterations = iterations, max(10, iterations)
        step = load_physics(engine, model).step
        read = jax.jit(jax.vmap(lambda s, u: read_contacts(model, step(s, u))))
        return np.asarray(read(state, tau).force)

    exact = force("mujoco", 100)
    rows = []
    for engine, iterations in (
        ("mujoco", 1),
        ("mujoco", 2),
        ("mujoco", 4),
        ("mujoco", 10),
        ("mjx", 4),
        ("mjx", 10),
        ("mjx", 100),
    ):
        error = np.abs(force(engine, iterations) - exact).max(axis=1)
        scale = exact.max()
        note = f"{size} states after contact; forces up to {scale:.0f} N"
        for label, q in (("p95", 95), ("max", 100)):
            key = f"force_error_{label}_{engine}_{iterations}_iterations"
            rows.append(Row(key, float(np.percentile(error, q)), "N", note))
    return rows


def plot(rows: list[Row], path: Path) -> None:
    """Path error over the timestep, both controllers."""
    table = {row.key: row.value for row in rows}
    figure, axes = plt.subplots(figsize=(5.2, 3.4), layout="constrained")
    for controller, color in zip(CONTROLLERS, ("tab:blue", "tab:orange"), strict=True):
        for seconds, style in (("1s", "-"), ("5s", "--")):
            key = f"path_error_{seconds}_median_{controller}_{{:g}}ms"
            points = [
                (dt * 1e3, table[key.format(dt * 1e3)])
                for dt in TIMESTEPS
                if key.format(dt * 1e3) in table
            ]
            label = f"{controller}, after {seconds[:-1]} s"
            axes.plot(
                *zip(*points, strict=True), style, color=color, marker="o", label=label
            )
    axes.set(xscale="log", yscale="log", xlabel="timestep [ms]")
    axes.set(ylabel="end-effector error, median [mm]", xticks=[2, 2.5, 5, 10])
    axes.set_xticklabels(["2", "2.5", "5", "10"])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    save_figure(figure, path, dpi=150)
    plt.close(figure)


def main(argv: list[str] | None = None) -> None:
    """Measure, print, and write the requested files."""
    args = parse(argv)
    runtime.configure()
    size = 16 if args.quick else args.num_envs
    timesteps = (2e-3, 5e-3) if args.quick else TIMESTEPS
    study, rows, rough = Study(size, args.seed), [], None
    for controller in CONTROLLERS:
        best = study.run(controller, timesteps[0])
        note = f"against {timesteps[0] * 1e3:g} ms"
        for dt in timesteps:
            mine = best if dt == timesteps[0] else study.run(controller, dt)
            name = f"{controller}_{dt * 1e3:g}ms"
            rows += compare(name, mine, best, note)
            rough = mine if dt == 5e-3 else rough
        if controller == "rmp_vices":
            for integrator in INTEGRATORS[1:] if not args.quick else ():
                mine = study.run(controller, 5e-3, integrator)
                name = f"{controller}_5ms_{integrator}"
                rows += compare(name, mine, best, note)
    assert rough is not None
    rows += solver_rows(rough, size)  # VICES at 5 ms: it collides
    show(rows, "Timestep, integrator and solver iterations")
    if args.plot:
        plot(rows, args.plot)
    if args.json:
        write_json(args.json, rows, seed=args.seed, num_envs=size, quick=args.quick)


if __name__ == "__main__":
    main()
