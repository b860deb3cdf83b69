"""Block pushing: a weighted block to a goal on the table (the paper's own task)."""

from __future__ import annotations

import dataclasses
import itertools
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from rmp_mjx.math import quat_to_mat
from rmp_mjx.metric import Metric
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.robot.kinematics import SiteState
from rmp_mjx.sim import PhysicsState

from . import options
from .base import ArmEnv
from .placement import CANDIDATES
from .safety import SafetyRecord
from .scene import ASSETS, TABLE_HEIGHT, Contacts
from .stands import Place
from .task import GOAL, Mark
from .types import Entry, Score, State

HALF_SIZE = 0.03
"""Half an edge of the block [m]."""

REST_HEIGHT = TABLE_HEIGHT + HALF_SIZE
"""Height of the centre of the block when it stands on the table [m]."""

BLOCK_LOW, BLOCK_HIGH = np.array([0.42, -0.10]), np.array([0.52, 0.10])
"""Corners of the area where the block starts [m]."""

GOAL_LOW, GOAL_HIGH = np.array([0.38, -0.26]), np.array([0.58, 0.26])
"""Corners of the area where the goal may be [m]."""

BEHIND = 0.045
"""Where the hand belongs: this far behind the block's centre, seen from the goal [m].
The finger touches the block at 5.2 cm, so a hand on its way there pushes."""

HAND_ROOM = 0.085
"""Distance behind the block's centre that is kept clear for the hand [m]."""

NEAREST_GOAL, FARTHEST_GOAL = 0.10, 0.25
"""Distance of the goal from where the block starts [m]."""


@dataclasses.dataclass(frozen=True)
class PushOptions(options.Options):
    """Options of block pushing."""

    env: ClassVar[str] = "push"
    episode_length: int = 256
    """Policy steps until the time limit; the paper's is 1024."""
    block_mass: float = 0.3
    """Mass of the block [kg]."""
    block_friction: float = 0.5
    """Sliding friction of the block on the table and on the hand."""
    guided: bool = True
    """Reward the hand for being where it pushes the block towards the goal, and tell
    the policy where that is; `False`: the paper's reward and observation."""

    def __post_init__(self):
        """Check the values."""
        super().__post_init__()
        for name in ("block_mass", "block_friction"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


class Push(ArmEnv[PushOptions]):
    """Push the block to within 5 cm of the goal, and keep it there.

    Reward in every step, with the distances h of the grip to its place behind the block
    (`guided=False`: to the block) and g of the block to the goal:
    ``5 (1 - tanh 20 h) + 50 (1 - tanh 20 g)``; an event costs `event_penalty`.
    The block alone may be touched, by the hand alone.
    """

    Options = PushOptions
    q_start = np.array([3.152, 3.878, -0.009, 1.317, 0.065, 3.708, 3.147])
    sphere_box = (np.array([0.32, -0.28, -0.05]), np.array([0.60, 0.28, 0.20]))
    task_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("goal_distance", "last", unit="m", headline="goal", table=("mean",)),
    )
    fixture_slots: ClassVar[dict[str, int]] = {"boxes": 1}
    hand_reward, goal_reward = 5.0, 50.0
    slope = 20.0
    """Slope of the rewards ``1 - tanh(slope d)`` [1/m]."""
    reach = 0.05
    """The block counts as pushed home within this distance of the goal [m]."""

    @classmethod
    def places(cls) -> list[Place]:
        """All round where the block starts and may go, beside it and above it."""
        low, high = BLOCK_LOW[0] - HAND_ROOM, BLOCK_HIGH[0] + HAND_ROOM
        heights = REST_HEIGHT, REST_HEIGHT + HAND_ROOM
        corners = itertools.product((low, high), (GOAL_LOW[1], GOAL_HIGH[1]), heights)
        return [Place(np.array(corner)) for corner in corners]

    @property
    def task_entries(self) -> tuple[Entry, ...]:
        """The block from the grip, the goal from the block, the way to push."""
        place = Entry(
            "hand_to_place", 3, "m", "where it is to be pushed, from the grip"
        )
        return (
            Entry("hand_to_block", 3, "m", "block's centre from the grip"),
            Entry("block_to_goal", 3, "m", "goal from the block's centre"),
            *((place,) if self.options.guided else ()),
        )

    def objects(self, spec: mujoco.MjSpec) -> Contacts:
        """Stand the block on the table."""
        asset = mujoco.MjSpec.from_file(str(ASSETS / "push.xml"))
        asset.option.timestep = spec.option.timestep
        asset.geom("block").mass = self.options.block_mass
        spec.attach(asset, prefix="push/", frame=spec.worldbody.add_frame())
        friction = self.options.block_friction
        return Contacts(
            work=("push/block",),
            work_friction=friction,
            passive=(("push/block", "table", friction),),
        )

    def fixtures(self, slots: Obstacles, data: PhysicsState) -> Obstacles:
        """The block, which the hand alone may touch."""
        n = self.robot.n
        R = quat_to_mat(data.qpos[n + 3 : n + 7])
        return slots.with_boxes(
            self.block(data)[None],
            np.full((1, 3), HALF_SIZE),
            R[None],
            velocities=data.qvel[None, n : n + 3],
            angular_velocities=(R @ data.qvel[n + 3 : n + 6])[None],
            hand_may_touch=True,
        )

    def begin(
        self, rng: Array, q: Float[Array, " n"]
    ) -> tuple[Array, dict[str, Array]]:
        """Place the block, turned at random, and a goal that it can be pushed to."""
        key_block, key_turn, key_goal = jax.random.split(rng, 3)
        block = jax.random.uniform(key_block, (2,), minval=BLOCK_LOW, maxval=BLOCK_HIGH)
        half_turn = 0.5 * jax.random.uniform(key_turn, minval=-0.785, maxval=0.785)
        goals = jax.random.uniform(
            key_goal, (CANDIDATES, 2), minval=GOAL_LOW, maxval=GOAL_HIGH
        )
        distance = jnp.linalg.norm(goals - block, axis=-1)
        fits = (distance >= NEAREST_GOAL) & (distance <= FARTHEST_GOAL)
        goal = jnp.append(goals[jnp.argmax(fits)], REST_HEIGHT)
        start = jnp.append(block, REST_HEIGHT)
        turn = jnp.array([jnp.cos(half_turn), 0.0, 0.0, jnp.sin(half_turn)])
        return jnp.concatenate([start, turn]), {"goal": goal, "start": start}

    def block(self, data: PhysicsState) -> Float[Array, " 3"]:
        """Centre of the block [m]."""
        n = self.robot.n
        return data.qpos[n : n + 3]

    def place(self, block: Array, goal: Array) -> Float[Array, " 3"]:
        """Where the hand belongs while it pushes the block to its goal [m]."""
        way = goal - block
        return block - BEHIND * way / jnp.maximum(jnp.linalg.norm(way), 1e-6)

    def keep_clear(self, task: dict[str, Array]) -> Float[Array, "v 3"]:
        """The block's top all along its straight way, and room behind it for the hand.

        A sphere of 5 cm that keeps its centre 8 cm from them is clear of block and
        goal, whichever way the block is turned.
        """
        way = task["goal"] - task["start"]
        ahead = way / jnp.linalg.norm(way)
        tail = task["start"] - HAND_ROOM * ahead
        share = jnp.linspace(0.0, 1.0, 8)[:, None, None]
        center = tail + share * (task["goal"] - tail)
        turn = np.arange(6) * np.pi / 3
        spoke = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
        rim = np.sqrt(2.0) * HALF_SIZE * np.concatenate([np.zeros((1, 3)), spoke])
        top = rim + np.array([0.0, 0.0, HALF_SIZE])
        return (center + top).reshape(-1, 3)

    def score(
        self,
        data: PhysicsState,
        site: SiteState,
        record: SafetyRecord,
        task: dict[str, Array],
        step: Array,
    ) -> Score:
        """Reward the hand for being in its place, the block for nearing the goal."""
        block, goal = self.block(data), task["goal"]
        place = self.place(block, goal) if self.options.guided else block
        hand, left = (jnp.linalg.norm(x) for x in (place - site.p, goal - block))
        reward = self.hand_reward * (1.0 - jnp.tanh(self.slope * hand))
        reward += self.goal_reward * (1.0 - jnp.tanh(self.slope * left))
        return Score(task, reward, left < self.reach, {"goal_distance": left})

    def observe(
        self, data: PhysicsState, site: SiteState, task: dict[str, Array]
    ) -> dict[str, Array]:
        """Hand to block, block to goal, hand to its place."""
        block, goal = self.block(data), task["goal"]
        return {
            "hand_to_block": block - site.p,
            "block_to_goal": goal - block,
            "hand_to_place": self.place(block, goal) - site.p,
        }

    def marks(self, state: State) -> list[Mark]:
        """A disc at the goal, as large as the block's reach."""
        x, y, _ = np.asarray(state.task["goal"], float)
        return [Mark("disc", np.array([x, y, TABLE_HEIGHT]), self.reach, GOAL)]
