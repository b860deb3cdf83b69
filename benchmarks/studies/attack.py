"""An attacker that is paid for contacts of a moving arm, with and without the guard.

It owns the set-point, the stiffness and the spheres, which move as it likes up to the
stated speed. PPO trains it against the guard to make a link touch something while the
link moves, and to drive joints to their limits. Then its events are counted, with the
guard and without. Run as ``python -m benchmarks.attack --json FILE``.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import envs
import rmp_mjx as rmp
from benchmarks.common import Row, insert, markdown, show, write_json
from benchmarks.studies.random_policies import poisson
from envs.options import CTRL_DT
from envs.safety import LIMIT_MARGIN
from envs.scene import ARM
from envs.types import State
from rmp_mjx import runtime, sim
from rmp_mjx.control.guard import StopGuard
from rmp_mjx.metric import SUCCESS, Metric, by_name
from rmp_mjx.pytree import Pytree
from rmp_mjx.robot.kinematics import arm_state
from rmp_mjx.robot.point_state import point_carrier, point_state
from rmp_mjx.sim.base import pair_sensors
from rmp_mjx.training.config import PPOConfig
from rmp_mjx.training.learning.ppo import PPO, make_ppo

SPHERES, RADIUS, SPEED = 3, 0.05, 0.2
"""Spheres, their radius [m] and their greatest speed [m/s]."""

U = 0.05
"""Speed of the arm at a contact that the guard allows [m/s]."""

CONTROLLERS = {"rmp_vices": rmp.RMPVICES, "vices": rmp.VICES}
"""What is attacked."""

METRICS = (
    SUCCESS,
    Metric("contacts", "sum", event=True, headline="contacts"),
    Metric("moving", "sum", event=True, headline="moving"),
    Metric("limits", "sum", event=True, headline="limits"),
    Metric("mispredicted", "sum"),
    Metric("unproved", "sum"),
    Metric("used", "mean"),
    Metric("speed", "max", unit="m/s"),
    Metric("travel", "mean", unit="rad/s"),
)
"""What a step counts: contacts that begin, those of a link faster than the guard's
speed, joint limits; physics steps that went otherwise than predicted, or began without
a proof; the guard's share; the greatest speed of a link at a contact; joint speed."""


class Guarded(Pytree):
    """A controller with the guard behind it; without one, only its figures."""

    controller: rmp.RMPVICES | rmp.VICES
    """The controller."""
    guard: StopGuard
    """The guard."""
    on: Array | bool = True
    """Whether its torque is sent."""

    def decode(self, action: Array) -> Any:
        """The controller's action."""
        return self.controller.decode(action)

    def setpoint(self, q: Array, action: Any, time: Any) -> Any:
        """The controller's target."""
        return self.controller.setpoint(q, action, time)

    def __call__(self, q, qd, setpoint, obstacles):
        """The controller's output with the guard's torque and diagnostics."""
        robot = self.controller.robot
        out = self.controller(q, qd, setpoint, obstacles)
        arm = arm_state(robot, q, qd)
        tau, found = self.guard(robot, arm, out.tau, out.Mq, out.bias, obstacles)
        tau = jnp.where(self.on, tau, out.tau)
        return out.replace(tau=tau, diagnostics=out.diagnostics | found)


class Attack:
    """The attacker's environment, in Brax's convention: see `rollout.Env`."""

    dt = CTRL_DT
    episode_length = 100
    engine = "attack"

    def __init__(self, controller: Guarded, speed: float = SPEED, noise: float = 0.1):
        """Build the scene.

        Args:
            controller: What is attacked.
            speed: Greatest speed of the spheres [m/s].
            noise: Standard deviation of the start configuration [rad].
        """
        self.env = envs.load(
            "trajectory",
            controller=controller,
            obstacles=SPHERES,
            sphere_radius=RADIUS,
            layout="close",
            obstacle_speed=speed,
            start_noise=noise,
            physics="mujoco",
            observer="none",
        )
        self.controller, self.speed = controller, speed
        self.action_size = rmp.ACTION_SIZE + 3 * SPHERES
        self.metrics = by_name(METRICS)
        self._links = self._pair_links()
        self.observation_size = len(self._start(jax.random.key(0)).obs)

    def _pair_links(self) -> np.ndarray:
        """The two links of every watched pair, (pairs, 2); n for what is no link."""
        model, robot = self.env.scene.model, self.env.robot
        link = {
            model.geom(ARM + name).id: k if k >= 0 else robot.n
            for name, k in zip(robot.capsules.geom, robot.capsules.segment, strict=True)
        }
        ids = (
            (model.sensor_objid[s], model.sensor_refid[s]) for s in pair_sensors(model)
        )
        return np.array([[link.get(int(g), robot.n) for g in pair] for pair in ids])

    def _start(self, rng: Array) -> State:
        state = self.env.reset(rng)
        metrics = {name: jnp.zeros(()) for name in self.metrics}
        state = state.replace(metrics=metrics)
        return state.replace(obs=self._observe(state)[0])

    def reset(self, rng: Array) -> State:
        """The arm at rest somewhere, spheres somewhere."""
        return self._start(rng)

    def _speeds(self, arm: Any) -> tuple[Array, Array]:
        """Greatest speeds at the control points, surface included, and of the links."""
        robot, points = self.env.robot, point_state(self.env.robot, arm)
        segment = np.array(robot.points.segment)
        spin = jnp.sqrt(arm.V.ang @ arm.V.ang)[segment]
        speed = jnp.sqrt(points.v @ points.v) + spin * jnp.asarray(robot.points.radius)
        return speed, jnp.max(point_carrier(robot) * speed[None], axis=1)

    def _contact_speed(self, data: Any, spheres: Any, touching: Array) -> Array:
        """Speed of the arm where it touches [m/s], 0 if it does not.

        At an obstacle it is that of the control point that is nearest to one, between
        two links the greater of theirs.
        """
        env, n = self.env, self.env.robot.n
        arm = arm_state(env.robot, data.qpos[:n], data.qvel[:n])
        points, links = self._speeds(arm)
        least, speed = jnp.inf, jnp.zeros(())
        for gap in env.gaps(data, spheres):
            d = jnp.min(jnp.where(gap.active, gap.distance, jnp.inf), axis=0)
            i = jnp.argmin(d)
            speed = jnp.where(d[i] < least, points[i], speed)
            least = jnp.minimum(least, d[i])
        inner = env.scene.self_pairs
        pairs = jnp.max(jnp.append(links, 0.0)[self._links], axis=1)
        outer = jnp.where(jnp.any(touching & ~inner), speed, 0.0)
        return jnp.maximum(outer, jnp.max(jnp.where(touching & inner, pairs, 0.0)))

    def _observe(self, state: State) -> tuple[Array, Array]:
        """What the attacker sees, and how dangerous it is."""
        env, n = self.env, self.env.robot.n
        q, qd = state.data.qpos[:n], state.data.qvel[:n]
        speed, _ = self._speeds(arm_state(env.robot, q, qd))
        centers = state.data.mocap_pos
        seen = [jnp.sin(q), jnp.cos(q), qd, env.site(state.data).p]
        danger = jnp.zeros(())
        for gap in env.gaps(state.data, state.info["spheres"]):
            d = jnp.where(gap.active, gap.distance, 1.0)
            danger = jnp.maximum(danger, jnp.max(speed * jnp.exp(-d / 0.02)))
            nearest = jnp.argmin(d, axis=1)
            rows = jnp.arange(len(nearest))
            normal = [
                jnp.broadcast_to(c, d.shape)[rows, nearest]
                for c in (gap.normal.x, gap.normal.y, gap.normal.z)
            ]
            seen += [jnp.min(d, axis=1), *normal]
        seen.append((centers - env.site(state.data).p[None]).reshape(-1))
        room = jnp.minimum(q - env.robot.q_lower, env.robot.q_upper - q)
        room = jnp.min(room) - LIMIT_MARGIN
        fast = jnp.max(jnp.abs(qd))
        seen.append(jnp.clip(room, 0.0, 1.0)[None])
        limit = jnp.exp(-jnp.maximum(room, 0.0) / 0.05) * fast
        return jnp.concatenate(seen), 5.0 * danger + 0.5 * limit

    def step(self, state: State, action: Array) -> State:
        """One policy step: every physics step is watched until something touches."""
        env, ctrl, n = self.env, self.controller, self.env.robot.n
        data, spheres = state.data, state.info["spheres"]
        wish = action[rmp.ACTION_SIZE :].reshape(SPHERES, 3)
        size = jnp.linalg.norm(wish, axis=1, keepdims=True)
        velocity = self.speed * wish / jnp.maximum(size, 1.0)
        spheres = spheres.replace(velocity=spheres.placed[:, None] * velocity)
        target = ctrl.decode(action[: rmp.ACTION_SIZE])
        target = ctrl.setpoint(data.qpos[:n], target, self.dt * state.info["step"])

        def substep(carry, _):
            data, touched, found = carry
            q, qd = data.qpos[:n], data.qvel[:n]
            out = ctrl(q, qd, target, env.obstacles(data, spheres))
            moved = data.mocap_pos + env.sim_dt * spheres.velocity
            before = data.replace(mocap_pos=moved)
            data = env.physics.step(before, out.tau)
            # The engine finds contacts where the step began.
            touching = sim.read_contacts(env.scene.model, data).touching
            speed = self._contact_speed(before, spheres, touching)
            begins = jnp.any(touching) & ~touched
            q = data.qpos[:n]
            room = jnp.minimum(q - env.robot.q_lower, env.robot.q_upper - q)
            limit = jnp.any(room < LIMIT_MARGIN)
            touched |= jnp.any(touching)
            guard = ctrl.guard
            kept = guard.kept(out.diagnostics["guard_qd"], data.qvel[:n])
            now = {
                "contacts": begins,
                "moving": begins & (speed > guard.speed),
                "limits": limit,
                "mispredicted": ~kept & ~touched & jnp.asarray(ctrl.on),
                "unproved": (out.diagnostics["guard_assumptions"] > 0) & ~touched,
                "used": out.diagnostics["guard_used"] / env.n_substeps,
                "speed": jnp.where(begins, speed, 0.0),
                "travel": jnp.mean(jnp.abs(qd)) / env.n_substeps,
            }
            now = {name: jnp.asarray(x, jnp.float32) for name, x in now.items()}
            more = {name: found[name] + x for name, x in now.items()}
            most = {"speed": jnp.maximum(found["speed"], now["speed"])}
            most |= {"limits": jnp.maximum(found["limits"], now["limits"])}
            return (data, touched, more | most), None

        zero = {m: jnp.zeros(()) for m in self.metrics if m != SUCCESS.name}
        start = (data, jnp.zeros((), bool), zero)
        (data, touched, found), _ = jax.lax.scan(
            substep, start, None, length=env.n_substeps
        )
        found[SUCCESS.name] = found["moving"]
        info = state.info | {"spheres": spheres, "step": state.info["step"] + 1}
        state = state.replace(data=data, info=info, metrics=state.metrics | found)
        obs, danger = self._observe(state)
        reward = danger + 20.0 * found["moving"] + 50.0 * found["speed"]
        reward += 20.0 * found["limits"]
        done = touched | (found["limits"] > 0)
        return state.replace(obs=obs, reward=reward, done=done.astype(jnp.float32))


def train(ppo: PPO, steps: int, seed: int) -> Any:
    """The attacker after so many policy steps."""
    state = jax.jit(ppo.init)(jax.random.key(seed))
    gather, learn = jax.jit(ppo.gather), jax.jit(ppo.learn)
    per = ppo.config.num_envs * ppo.config.unroll_length
    for i in range(max(steps // per, 1)):
        state, data, total = gather(state)
        state, _ = learn(state, data)
        if i % 10 == 9:
            sums = {k: float(v) / per for k, v in total.step_sums.items()}
            print(i + 1, {k: f"{1e3 * v:.3g}" for k, v in sums.items()}, flush=True)
    return state


def count(ppo: PPO, state: Any, steps: int) -> dict[str, float]:
    """Sums over at least so many policy steps of the trained, noisy attacker."""
    gather = jax.jit(ppo.gather)
    per = ppo.config.num_envs * ppo.config.unroll_length
    sums: dict[str, float] = {"steps": 0.0, "worst": 0.0}
    while sums["steps"] < steps:
        state, _, total = gather(state)
        sums["steps"] += per
        episodes = float(total.episodes)
        sums["episodes"] = sums.get("episodes", 0.0) + episodes
        for name, value in total.step_sums.items():
            sums[name] = sums.get(name, 0.0) + float(value)
        for name in ("used", "travel", "speed"):
            whole = float(total.episode_sums[name])
            sums[name] = sums.get(name, 0.0) + whole
    return sums


def rows_of(name: str, sums: dict[str, float], substeps: int) -> list[Row]:
    """The figures of one controller under attack."""
    steps = sums["steps"]
    controls = substeps * steps
    rows = [Row(f"{name}_control_steps", controls, "", f"{steps:.0f} policy steps")]
    for event in ("contacts", "moving", "limits", "mispredicted", "unproved"):
        many = sums[event]
        _, top = poisson(int(many))
        note = f"95 % upper bound {1e6 * top / controls:.3g} per 10^6 control steps"
        rows.append(Row(f"{name}_{event}", many, "", note))
    episodes = max(sums["episodes"], 1.0)
    for key, unit in (("used", ""), ("travel", "rad/s"), ("speed", "m/s")):
        rows.append(
            Row(f"{name}_{key}", sums[key] / episodes, unit, "mean of episodes")
        )
    return rows


def table(rows: list[Row]) -> str:
    """The counts as a Markdown table, one line for each controller."""
    value = {row.key: row.value for row in rows}
    names = [
        key.removesuffix("_control_steps")
        for key in value
        if key.endswith("_control_steps")
    ]
    keys = ("contacts", "moving", "limits", "mispredicted", "unproved")
    head = (
        "",
        "control steps",
        "contacts",
        f"faster than {U * 100:g} cm/s",
        "joint limits",
        "mispredicted",
        "unproved",
    )
    lines = []
    for name in names:
        steps = f"{value[f'{name}_control_steps']:,.0f}"
        counts = [f"{value[f'{name}_{key}']:,.0f}" for key in keys]
        if not name.endswith("_guarded"):
            counts[3:] = ["-", "-"]
        lines.append((f"`{name}`", steps, *counts))
    return markdown(head, lines)


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(description="An attack on the guard.")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--docs", type=Path, help="update the table of this page")
    parser.add_argument("--quick", action="store_true", help="a smoke test: few steps")
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    parser.add_argument("--envs", type=int, default=256, help="number of worlds")
    parser.add_argument("--train", type=int, default=400_000, help="policy steps")
    parser.add_argument("--steps", type=int, default=100_000, help="policy steps")
    parser.add_argument("--speed", type=float, default=SPEED, help="of spheres [m/s]")
    parser.add_argument(
        "--controller",
        choices=tuple(CONTROLLERS),
        action="append",
        help="only this controller; may be repeated (default: all)",
    )
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    """Train, count, print, and write the requested file."""
    args = parse(argv)
    runtime.configure()
    if args.quick:
        args.envs, args.train, args.steps = 16, 256, 256
    config = PPOConfig(num_envs=args.envs, seed=args.seed, entropy_cost=1e-3)
    robot = rmp.Robot.load("jaco2")
    guard = StopGuard.of(robot, obstacle_speed=args.speed, speed=U)
    rows: list[Row] = []
    settings = {k: v for k, v in vars(args).items() if k not in ("json", "docs")}
    for name in args.controller or CONTROLLERS:
        start = time.perf_counter()
        controller = CONTROLLERS[name](robot)
        attacks = {
            f"{name}_guarded": Attack(Guarded(controller, guard, True), args.speed),
            name: Attack(Guarded(controller, guard, False), args.speed),
        }
        trained = None
        for key, env in attacks.items():
            ppo = make_ppo(env, config)
            if trained is None:  # it learns against the guard
                trained = train(ppo, args.train, args.seed)
            sums = count(ppo, trained, args.steps)
            new = rows_of(key, sums, env.env.n_substeps)
            show(new, f"{key}: {time.perf_counter() - start:.0f} s")
            rows += new
            if args.json:
                write_json(args.json, rows, **settings)
    if args.docs:
        args.docs.write_text(insert(args.docs.read_text(), {"attack": table(rows)}))


if __name__ == "__main__":
    main()
