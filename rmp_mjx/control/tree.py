"""The RMP-tree of RMP-VICES in its generic form: the definition of the controller.

Every Jacobian and curvature here comes from autodiff of the task maps. The fast
evaluation in `rmp_vices` is held to this tree by the tests.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rmp_mjx.control.leaves import CollisionLeaf, Leaves, leaf_of
from rmp_mjx.math import exp_so3, safe_norm
from rmp_mjx.obstacles import Obstacles
from rmp_mjx.pytree import Constant
from rmp_mjx.rmp import RMP, Leaf, Node, ScalarLeaf, Siblings, TaskMap, identity_map
from rmp_mjx.rmp.leaves.attractor import OrientationAttractor, PositionAttractor
from rmp_mjx.rmp.leaves.posture import Posture
from rmp_mjx.robot.kinematics import base_point, forward_kinematics, site_pose
from rmp_mjx.robot.model import Robot
from rmp_mjx.shapes import KINDS, Boxes, Capsules, Planes, Shape, Spheres
from rmp_mjx.types import Setpoint


def rmp_vices_tree(
    robot: Robot,
    leaves: Leaves,
    setpoint: Setpoint,
    obstacles: Obstacles,
    Mq: Float[Array, "n n"],
    attractor_weight: Float[Constant, ""] | float,
    orientation_weight: Float[Constant, ""] | float,
    turning_by_contact: Float[Constant, " 3"] | float = 0.0,
) -> Node:
    """The controller's tree with the joints at its root (the paper's figure 2).

    Args:
        robot: The arm.
        leaves: All leaves but the attractors, with the policy's weights and the time to
            stop in this state.
        setpoint: Impedance target, the dither included.
        obstacles: Obstacle slots.
        Mq: Inertia, the metric of the posture leaf.
        attractor_weight: Metric of the two attractors.
        orientation_weight: Further weight of the orientation attractor, in this state.
        turning_by_contact: Angular acceleration that it asks back, (3,) [rad/s^2].
    """
    turning = attractor_weight * orientation_weight
    position = PositionAttractor(
        setpoint.p_des, setpoint.kp_pos, weight=attractor_weight
    )
    orientation = OrientationAttractor(
        setpoint.R_des,
        setpoint.kp_ori,
        weight=turning,
        feedforward=-turning_by_contact,
    )
    children: list[Node | Siblings | Leaf] = [
        Node(TaskMap(lambda q: site_pose(robot, q)[0]), (position,)),
        Node(TaskMap(lambda q: site_pose(robot, q)[1]), (orientation,)),
    ]
    if leaves.joint_limit is not None:
        children.append(leaves.joint_limit)
    if leaves.posture is not None:
        children.append(InertialPosture(leaves.posture, Mq))
    if leaves.collision is not None and obstacles.kinds and robot.points.segment:
        children.append(_point_nodes(robot, obstacles, leaves.collision))
    if leaves.self_collision is not None and robot.capsules.pairs:
        children.append(_self_node(robot, leaves.self_collision))
    return Node(identity_map(), tuple(children))


class InertialPosture(Leaf):
    """The posture leaf with the inertia as its metric."""

    posture: Posture
    """The leaf."""
    Mq: Float[Array, "n n"]
    """Inertia at the current configuration [kg m^2]."""

    def __call__(self, x: Float[Array, " n"], xd: Float[Array, " n"]) -> RMP:
        """RMP at q, qd."""
        return self.posture(x, xd, self.Mq)


class Masked(Leaf):
    """A leaf that counts only where its obstacle slot is in use."""

    leaf: ScalarLeaf
    """The leaf."""
    active: Bool[Array, "*o 1"]
    """Whether the slot is in use; o slots for o stacked siblings."""

    def __call__(self, x: Float[Array, " m"], xd: Float[Array, " m"]) -> RMP:
        """RMP at a distance and its rate."""
        return self._where_active(self.leaf(x, xd))

    def against(
        self, x: Float[Array, " m"], xd: Float[Array, " m"], push: Float[Array, " m"]
    ) -> RMP:
        """RMP at a distance and its rate, and its acceleration by contacts."""
        return self._where_active(self.leaf.against(x, xd, push))

    def _where_active(self, rmp: RMP) -> RMP:
        return RMP(f=rmp.f * self.active, M=rmp.M * self.active[:, None])


def _point_nodes(robot: Robot, obstacles: Obstacles, leaf: CollisionLeaf) -> Siblings:
    """Control points as siblings, each with one sibling per obstacle slot."""
    points = robot.points
    one_hot = np.arange(robot.n)[None] == np.array(points.segment)[:, None]

    def position(params, q):
        offset, link = params
        p, R = forward_kinematics(robot, q)
        return base_point(robot) + (p + jnp.einsum("ijn,j->in", R, offset)) @ link

    def node(k):
        siblings = []
        for kind in obstacles.kinds:
            own = leaf_of(leaf, KINDS[type(kind)])
            if own is None:
                continue
            slots = kind.active.shape[0]
            params, rates = _moving(kind)
            params["rho"] = jnp.full(slots, points.radius[k])
            rates["rho"] = jnp.zeros(slots)
            active = kind.active & ~(kind.hand_may_touch & bool(points.hand[k]))
            active = jnp.asarray(active)[:, None]
            masked = Masked(_at_point(own, (slots, len(one_hot)), k), active)
            distance = TaskMap(DISTANCE[type(kind)], params, rates)
            siblings.append(Siblings(Node(distance, (masked,))))
        offset = jnp.asarray(points.offset[k])
        link = jnp.asarray(one_hot[k], offset.dtype)
        return Node(TaskMap(position, (offset, link)), tuple(siblings))

    return Siblings.stack([node(k) for k in range(len(one_hot))])


def _at_point(leaf: ScalarLeaf, shape: tuple[int, int], k: int) -> ScalarLeaf:
    """The leaf of control point k, its parameters one for each obstacle slot."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, shape)[:, k], leaf)


def _moving(kind: Shape) -> tuple[dict[str, Array], dict[str, Array]]:
    """Parameters of an obstacle's distance map and their rates."""
    fields = dict(vars(kind))
    del fields["active"], fields["hand_may_touch"]
    velocity = fields.pop("velocity")
    spin = fields.pop("angular_velocity", None)
    rates = jax.tree.map(jnp.zeros_like, fields)
    rates["point" if "point" in fields else "center"] = velocity
    if spin is not None:
        fields["turn"], rates["turn"] = jnp.zeros_like(spin), spin
    return fields, rates


def _sphere(o: dict[str, Array], x: Array) -> Array:
    return safe_norm(x - o["center"]) - o["radius"] - o["rho"]


def _plane(o: dict[str, Array], x: Array) -> Array:
    return jnp.dot(x - o["point"], o["normal"]) - o["rho"]


def _capsule(o: dict[str, Array], x: Array) -> Array:
    r = exp_so3(o["turn"]).T @ (x - o["center"])
    along = jnp.clip(jnp.dot(r, o["axis"]), -o["half_length"], o["half_length"])
    return safe_norm(r - along * o["axis"]) - o["radius"] - o["rho"]


def _box(o: dict[str, Array], x: Array) -> Array:
    r = o["rotation"].T @ exp_so3(o["turn"]).T @ (x - o["center"])
    over = jnp.abs(r) - o["half_size"]
    outside = safe_norm(jnp.maximum(over, 0.0))
    return outside + jnp.minimum(jnp.max(over), 0.0) - o["radius"] - o["rho"]


DISTANCE = {Spheres: _sphere, Planes: _plane, Capsules: _capsule, Boxes: _box}
"""Distance map of each kind of obstacle."""


def _self_node(robot: Robot, leaf: ScalarLeaf) -> Node:
    """All capsule pairs as one node: the distances of the pairs that can touch."""
    capsules = robot.capsules
    ids = np.array(capsules.pairs).T
    radii = jnp.sum(capsules.radius[ids], axis=0)

    def distances(q):
        p, R = forward_kinematics(robot, q)
        p = jnp.concatenate([-base_point(robot)[:, None], p], axis=1)
        R = jnp.concatenate([jnp.eye(3)[:, :, None], R], axis=2)
        frame = np.array(capsules.segment) + 1
        ends = [
            p[:, frame].T + jnp.einsum("ijc,cj->ci", R[:, :, frame], jnp.asarray(end))
            for end in (capsules.start, capsules.end)
        ]
        pair = jax.vmap(_segment_distance)
        (a0, a1), (b0, b1) = (([e[i] for e in ends]) for i in ids)
        return pair(a0, a1, b0, b1) - radii

    return Node(TaskMap(distances), (leaf,))


def _segment_distance(a0: Array, a1: Array, b0: Array, b1: Array) -> Array:
    """Distance of two segments: the least over the interior and the four ends."""
    da, db, r = a1 - a0, b1 - b0, a0 - b0
    aa, bb, ab = da @ da, db @ db, da @ db
    det = aa * bb - ab * ab
    skewed = det > 1e-6 * aa * bb + 1e-9
    safe = jnp.where(skewed, det, 1.0)
    s = (ab * (db @ r) - (da @ r) * bb) / safe
    t = (aa * (db @ r) - (da @ r) * ab) / safe
    crossing = skewed & (s > 0) & (s < 1) & (t > 0) & (t < 1)
    inner = safe_norm(
        r + jnp.where(crossing, s, 0.0) * da - jnp.where(crossing, t, 0.0) * db
    )
    ends = jnp.stack(
        [
            _point_segment(a0, b0, db),
            _point_segment(a1, b0, db),
            _point_segment(b0, a0, da),
            _point_segment(b1, a0, da),
        ]
    )
    return jnp.where(crossing, inner, jnp.min(ends))


def _point_segment(x: Array, start: Array, along: Array) -> Array:
    length2 = along @ along
    t = jnp.clip(
        (x - start) @ along / jnp.where(length2 > 1e-9, length2, 1.0), 0.0, 1.0
    )
    return safe_norm(x - start - t * along)
