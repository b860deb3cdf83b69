"""Three failures by name: wedged behind a sphere, too weak to brake, blocked at work.

Each function runs both controllers and returns rows and a Markdown table;
`benchmarks.robustness` calls them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import envs
from benchmarks.common import Row, markdown
from benchmarks.studies import experts
from benchmarks.studies.policies import POLICIES, stiffness
from benchmarks.studies.safety_study import World, advance
from envs import spheres
from envs.base import ArmEnv
from envs.safety import ENDING
from rmp_mjx.training.stats import clopper_pearson

CONTROLLERS = {"rmp_vices": "RMP-VICES", "vices": "VICES"}
"""Controllers and their names in the tables."""

Figures = dict[str, np.ndarray]

AWAY = np.inf
"""Offset of a sphere that is not there."""

TRAPS = {
    "one sphere, in the middle": (0.0, AWAY),
    "one, 5 mm beside": (0.005, AWAY),
    "one, 20 mm beside": (0.02, AWAY),
    "two that touch": (-0.05, 0.05),
    "two, 40 mm apart": (-0.07, 0.07),
}
"""Offsets of the centres of two 5 cm spheres from the straight way [m]."""

TORQUES = (1.0, 0.7, 0.5, 0.4, 0.3)
"""Shares of the torque limits."""

DRAWS = 8
"""Starts drawn for each one that is kept."""

REACHING = 300
"""Policy steps to get past the sphere (15 s)."""

STANDING = 0.01
"""A grip slower than this counts as standing [m/s]."""

APPROACH, HOLD = 120, 400
"""Policy steps to reach the block, and to push against it (20 s)."""

BLOCKED = (20.0, 50.0, 100.0, 300.0)
"""Orientation stiffnesses at a block that does not move [1/s^2]."""


class Crossing(NamedTuple):
    """A straight way with spheres in it, and the torque limits."""

    offset: Array
    """Offsets of two spheres' centres from the way, to one side, (2,) [m]."""
    torque: Array
    """Share of the torque limits."""


def crossing_start(env: ArmEnv, key: Array, case: Crossing) -> tuple[World, Array]:
    """A world whose spheres are halfway to its only target, and whether it is usable.

    It is usable with 24 cm to the target and 3 cm of clearance.
    """
    key_reset, key_side = jax.random.split(key)
    state = env.reset(key_reset)
    grip, points = env.site(state.data).p, state.task["points"]
    length = jnp.linalg.norm(points - grip, axis=-1)
    target = points[jnp.argmax(length)]
    ahead = (target - grip) / jnp.max(length)
    side = jnp.cross(ahead, jax.random.normal(key_side, (3,)))
    side = side / jnp.linalg.norm(side)
    placed = jnp.isfinite(case.offset)
    offset = jnp.where(placed, case.offset, 0.0)[:, None]
    center = 0.5 * (grip + target) + offset * side
    center = jnp.where(placed[:, None], center, jnp.array(spheres.AWAY))
    known = state.info["spheres"].replace(placed=placed)
    state = state.replace(
        data=state.data.replace(mocap_pos=center),
        info=state.info
        | {
            "task": state.task | {"points": jnp.tile(target, (len(points), 1))},
            "spheres": known,
        },
    )
    fits = (jnp.max(length) > 0.24) & (env.clearance(state.data, known) > 0.03)
    special = {"noise": 0.0, "delay": 0.0, "torque": case.torque}
    special = {k: jnp.asarray(v, jnp.float32) for k, v in special.items()}
    memory = jnp.zeros(env.action_size)
    return World(state, memory, special), fits


def crossing_keys(env: ArmEnv, cases: Crossing, worlds: int, seed: int) -> Array:
    """Keys of starts, at most `worlds`, that are usable in every case."""
    keys = jax.random.split(jax.random.key(seed), DRAWS * worlds)
    fits = jax.vmap(lambda key, case: crossing_start(env, key, case)[1], (None, 0))
    fit = jax.jit(jax.vmap(lambda key: jnp.all(fits(key, cases))))(keys)
    return keys[np.flatnonzero(fit)[:worlds]]


def cross(controller: str, cases: Crossing, worlds: int, seed: int) -> list[Figures]:
    """Head straight for the target, in the same worlds for each case.

    Returns:
        Figures of every step, (steps, worlds), case by case; `going` says that the
        target is not reached yet.
    """
    env = envs.load("trajectory", controller=controller, physics="mujoco", obstacles=2)
    policy = jnp.array(tuple(POLICIES).index("straight"))

    def episode(key: Array, case: Crossing) -> dict[str, Array]:
        world, _ = crossing_start(env, key, case)

        def step(world: World, key: Array) -> tuple[World, dict[str, Array]]:
            world, figures = advance(env, world, key, policy)
            going = world.state.task["reached"] == 0
            return world, figures | {"going": going}

        return jax.lax.scan(step, world, jax.random.split(key, REACHING))[1]

    keys = crossing_keys(env, cases, worlds, seed)
    both = jax.vmap(jax.vmap(episode, (0, None), 1), (None, 0), 1)
    figures = jax.tree.map(np.asarray, jax.jit(both)(keys, cases))
    count = len(cases.offset)
    return [{k: v[:, i] for k, v in figures.items()} for i in range(count)]


def share(hits: Any) -> tuple[float, str]:
    """Share of true entries, and its count with the exact 95 % interval."""
    low, high = clopper_pearson(int(hits.sum()), len(hits))
    text = f"{hits.sum()} of {len(hits)}; 95 % interval {low:.3f}-{high:.3f}"
    return float(hits.mean()), text


def wedging(worlds: int, seed: int) -> tuple[list[Row], str]:
    """How often and how long a straight push stands still behind a sphere."""
    cases = Crossing(jnp.array(list(TRAPS.values())), jnp.ones(len(TRAPS)))
    runs = {name: cross(name, cases, worlds, seed) for name in CONTROLLERS}
    rows, lines = [], []
    for i, trap in enumerate(TRAPS):
        for name, title in CONTROLLERS.items():
            figures = runs[name][i]
            going = figures["going"]
            event = np.array([figures[e] > 0 for e in ENDING]) & going
            event = event.any(axis=(0, 1))
            stood = 0.05 * ((figures["speed"] < STANDING) & going).sum(axis=0)
            took = 0.05 * (1 + going.sum(axis=0))
            reached, long = ~going[-1], stood >= 1.0
            parts = {"reached": reached, "stood": long, "event": event}
            shares = {what: share(hits) for what, hits in parts.items()}
            length = float(np.median(stood[long])) if long.any() else 0.0
            time = float(np.median(took[reached])) if reached.any() else np.inf
            key = f"wedging/{trap}/{name}"
            rows += [Row(f"{key}/{k}", v, "", note) for k, (v, note) in shares.items()]
            rows += [
                Row(f"{key}/standing", length, "s", "median of those that stood"),
                Row(f"{key}/time", time, "s", "median of those that reached"),
            ]
            percent = {what: f"{100 * v:.0f}" for what, (v, _) in shares.items()}
            lines.append(
                (
                    trap,
                    title,
                    percent["reached"],
                    f"{time:.1f}",
                    percent["stood"],
                    f"{length:.1f}",
                    percent["event"],
                )
            )
    head = (
        "in the way",
        "controller",
        "reached in 15 s [%]",
        "time, median [s]",
        "stood for 1 s or longer [%]",
        "median of those [s]",
        "event on the way [%]",
    )
    return rows, markdown(head, lines)


def braking(worlds: int, seed: int) -> tuple[list[Row], str]:
    """Whether the arm stops before a sphere in its way, by its torque limits."""
    alone = jnp.array(TRAPS["one sphere, in the middle"])
    cases = Crossing(jnp.tile(alone, (len(TORQUES), 1)), jnp.array(TORQUES))
    runs = {name: cross(name, cases, worlds, seed) for name in CONTROLLERS}
    rows, lines = [], []
    for i, torque in enumerate(TORQUES):
        for name, title in CONTROLLERS.items():
            figures = runs[name][i]
            going = figures["going"]
            hit, note = share(((figures["collision"] > 0) & going).any(axis=0))
            reached, among = share(~going[-1])
            least = 1e3 * np.where(going, figures["clearance"], np.inf).min(axis=0)
            middle, worst = float(np.median(least)), float(least.min())
            saturated = float(100 * figures["torque_saturation"][going].mean())
            key = f"braking/torque={torque}/{name}"
            rows += [
                Row(f"{key}/collision", hit, "", note),
                Row(f"{key}/reached", reached, "", among),
                Row(f"{key}/clearance", middle, "mm", f"median; worst {worst:.1f}"),
                Row(f"{key}/saturated", saturated, "%", "of physics steps"),
            ]
            lines.append(
                (
                    f"{100 * torque:g} %",
                    title,
                    f"{100 * hit:.0f}",
                    f"{middle:.0f} / {worst:.0f}",
                    f"{saturated:.1f}",
                    f"{100 * reached:.0f}",
                )
            )
    head = (
        "torque limits",
        "controller",
        "episodes with a collision [%]",
        "least clearance, median / worst [mm]",
        "saturated [%]",
        "reached in 15 s [%]",
    )
    return rows, markdown(head, lines)


class Pushing(NamedTuple):
    """Memory of a lasting push."""

    expert: experts.Memory
    """Memory of the expert that pushes, and returns if it slips off."""
    touched: Array
    """Whether the hand has met the block."""


def push_on(controller: str, kp_ori: np.ndarray, seed: int) -> Figures:
    """Push an immovable block, with one world for each orientation stiffness.

    Returns:
        `q` (steps, worlds, n) and figures of every step, (steps, worlds) each.
    """
    env = envs.load("push", controller=controller, physics="mujoco", block_mass=1e3)

    def episode(key: Array, tail: Array) -> dict[str, Array]:
        state = env.reset(key)
        memory = Pushing(experts.start(env, state), jnp.zeros((), bool))

        def step(carry, _):
            state, memory = carry
            expert, action = experts.push(env, state, memory.expert)
            touched = (expert.phase == experts.PUSH) & (state.metrics["work_force"] > 1)
            touched |= memory.touched
            state = env.step(state, action.at[9:].set(tail))
            names = (*ENDING, "work_force", "clearance", "torque_saturation")
            figures = {name: state.metrics[name] for name in names}
            figures |= {"q": state.data.qpos[: env.robot.n], "touched": touched}
            return (state, Pushing(expert, touched)), figures

        return jax.lax.scan(step, (state, memory), None, length=APPROACH + HOLD)[1]

    keys = jax.random.split(jax.random.key(seed), len(kp_ori))
    tails = jnp.array([stiffness(k) for k in kp_ori], jnp.float32)
    figures = jax.jit(jax.vmap(episode, out_axes=1))(keys, tails)
    figures = jax.tree.map(np.asarray, figures)
    low, high = env.robot.q_lower, env.robot.q_upper
    q = figures["q"]
    figures["room"] = np.minimum(q - low, high - q).min(axis=-1)
    return figures


def blocked(worlds: int, seed: int) -> tuple[list[Row], str]:
    """Effect on the arm of pushing an immovable block for 20 s."""
    rows, lines = [], []
    worlds = max(worlds // 4, 2)
    stiff = np.repeat(BLOCKED, worlds)
    for name, title in CONTROLLERS.items():
        figures = push_on(name, stiff, seed)
        first = figures["touched"].argmax(axis=0)
        held = figures["touched"][APPROACH]  # so that 20 s are left
        for kp in np.unique(stiff):
            chosen = np.flatnonzero(held & (stiff == kp))
            steps = first[chosen] + np.arange(HOLD)[:, None]
            of = {k: v[steps, chosen] for k, v in figures.items()}
            drift = np.abs(of["q"] - of["q"][:1]).max(axis=-1)
            early, late = of["work_force"][:40].mean(), of["work_force"][200:].mean()
            contact = float((of["work_force"] > 0).mean())
            room = of["room"].min(axis=0)
            limits = int((of["joint_limit"].sum(axis=0) > 0).sum())
            hits = int(((of["collision"] + of["self_collision"]).sum(axis=0) > 0).sum())
            key, note = f"blocked/kp_ori={kp:g}/{name}", f"{len(chosen)} episodes"
            after = [
                (float(np.median(drift[t])), float(drift[t].max())) for t in (39, -1)
            ]
            nearest = float(np.median(room)), float(room.min())
            rows += [
                Row(f"{key}/contact", contact, "", "of the policy steps"),
                Row(f"{key}/force_2s", float(early), "N", f"mean; {note}"),
                Row(f"{key}/force_20s", float(late), "N", "mean of the last 10 s"),
                Row(f"{key}/drift_2s", after[0][0], "rad", f"worst {after[0][1]:.2f}"),
                Row(f"{key}/drift_20s", after[1][0], "rad", f"worst {after[1][1]:.2f}"),
                Row(f"{key}/room", nearest[0], "rad", f"worst {nearest[1]:.2f}"),
                Row(f"{key}/joint_limit", limits, "episodes", note),
                Row(f"{key}/collision", hits, "episodes", note),
            ]
            lines.append(
                (
                    title,
                    f"{kp:g}",
                    f"{100 * contact:.0f}",
                    f"{early:.0f} / {late:.0f}",
                    " / ".join(f"{m:.2f} ({w:.2f})" for m, w in after),
                    "{:.2f} ({:.2f})".format(*nearest),
                    f"{limits} of {len(chosen)}",
                    f"{hits} of {len(chosen)}",
                )
            )
    head = (
        "controller",
        "orientation stiffness [1/s^2]",
        "in contact [%]",
        "force, first 2 s / last 10 s [N]",
        "joint drift after 2 s / 20 s, median (worst) [rad]",
        "least distance to a joint limit, median (worst) [rad]",
        "joint-limit events",
        "collisions",
    )
    return rows, markdown(head, lines)


FAILURES: dict[str, Callable[[int, int], tuple[list[Row], str]]] = {
    "wedging": wedging,
    "braking": braking,
    "blocked": blocked,
}
"""The failures by name: from a number of worlds and a seed to rows and a table."""
