r"""How the arm meets what it must not touch: speed, fault and energy of a collision.

A collision *begins* in a physics step in which an arm's part and another body overlap
that did not overlap in the step before; it lasts until they part. It is measured once,
when it begins. Engines find overlaps before they move, so the joint velocities at the
beginning of that step are those that led there, and no force of the collision has
changed them. With the arm's point $x$ there, its Jacobian $J$, and the normal $n$ from
the arm's part towards the other body:

$$
u = n^T J \dot q, \qquad
E = \tfrac12 m u^2, \quad m = \frac{1}{n^T J M^{-1} J^T n} .
$$

$u$ is the arm's *own* speed: a sphere that runs into an arm at rest has $u = 0$. The
other body's motion counts in the closing speed alone. $m$ is the arm's effective mass
along the normal (Khatib, 1995), its joints free, rotor inertias included.

Point and normal come from the shapes: the capsule around the arm's part, and the other
body's sphere, capsule, box or plane; a body of another shape counts as its bounding
box. Of one policy step the first `MOST` collisions are measured.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from rmp_mjx.math import exp_so3, psd_solve, quat_to_mat
from rmp_mjx.pytree import Pytree
from rmp_mjx.robot import Robot
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state, base_point
from rmp_mjx.sim import PhysicsState, read_contacts

from .scene import ARM, Scene

AT_FAULT = 0.01
"""A collision that begins while the arm itself moves towards the body faster than this
is the arm's fault [m/s]."""
MOST = 4
"""Collisions that are measured in one policy step; of more, the first ones."""
HALVINGS = 24
"""Steps of the search along a capsule's axis: to 2^-24 of its length."""
FAR = 10.0
"""Half the size of the box that stands for a plane [m]."""

Pairs = Bool[Array, " pairs"]


class Moment(Pytree):
    """One physics step, as far as it matters to collisions."""

    qpos: Float[Array, "*t nq"]
    """Positions at its beginning."""
    qvel: Float[Array, "*t nv"]
    """Velocities at its beginning."""
    centers: Float[Array, "*t k 3"]
    """Where the spheres are in it: they move before the arm does [m]."""
    velocity: Float[Array, "*t k 3"]
    """Their velocities [m/s]."""
    begun: Bool[Array, "*t pairs"]
    """Pairs of hand or arm whose collision began."""


class Impact(Pytree):
    """What is measured of the collisions that began; 0 where none did."""

    own: Float[Array, ""]
    """Greatest own speed of the arm towards the other body [m/s]."""
    closing: Float[Array, ""]
    """Greatest speed of the two towards each other [m/s]."""
    energy: Float[Array, ""]
    """Energy of the arm's own motion along the normal, where its own speed is greatest
    [J]."""

    @property
    def at_fault(self) -> Bool[Array, ""]:
        """Whether one of them was the arm's fault."""
        return self.own > AT_FAULT


def touching(scene: Scene, state: PhysicsState) -> Pairs:
    """Pairs of hand or arm with what they must not touch that overlap."""
    return read_contacts(scene.model, state).touching[: len(scene.other)]


def measure(scene: Scene, robot: Robot, moments: Moment) -> Impact:
    """The collisions of the physics steps of one policy step.

    Args:
        scene: The scene.
        robot: The arm.
        moments: Of every physics step, with a leading axis.
    """
    zero = jnp.zeros((), moments.qpos.dtype)
    if not len(scene.other):
        return Impact(zero, zero, zero)
    pairs = moments.begun.shape[1]
    rest, chosen, valid = moments.begun.reshape(-1), [], []
    for _ in range(MOST):
        chosen.append(jnp.argmax(rest))  # the first one
        valid.append(rest[chosen[-1]])
        rest = rest.at[chosen[-1]].set(False)
    chosen, valid = jnp.stack(chosen), jnp.stack(valid)
    then = jax.tree.map(lambda x: x[chosen // pairs], moments)
    row, own, closing = jax.vmap(lambda m, pair: _collision(scene, robot, m, pair))(
        then, chosen % pairs
    )
    own, closing = (jnp.where(valid, v, 0.0) for v in (own, closing))
    fastest = jnp.argmax(own)
    q = then.qpos[fastest, : robot.n]
    Mq, _ = dynamics(robot, arm_state(robot, q, jnp.zeros_like(q)))
    mobility = row[fastest] @ psd_solve(Mq, row[fastest])
    speed = jnp.maximum(own[fastest], 0.0)
    hit = (speed > 0.0) & (mobility > 0.0)
    energy = jnp.where(hit, 0.5 * speed**2 / jnp.where(hit, mobility, 1.0), 0.0)
    return Impact(speed, jnp.maximum(jnp.max(closing), 0.0), energy)


def _collision(
    scene: Scene, robot: Robot, moment: Moment, pair: Array
) -> tuple[Array, Array, Array]:
    """Row $n^T J$ of a pair, the arm's own speed along it, and the closing speed."""
    n, capsules, now = robot.n, robot.capsules, moment
    arm = arm_state(robot, now.qpos[:n], now.qvel[:n])
    capsule = jnp.asarray(scene.capsule)[pair]
    link = jnp.asarray(capsules.segment)[capsule]
    place, turn = arm.p[:, link] + base_point(robot), arm.R[..., link]
    ends = [
        place + turn @ jnp.asarray(end, now.qpos.dtype)[capsule]
        for end in (capsules.start, capsules.end)
    ]
    bodies = _bodies(scene, moment)
    number = jnp.asarray(np.unique(scene.other, return_inverse=True)[1])[pair]
    body, shape = jax.tree.map(lambda x: x[number], bodies)
    x, normal = _nearest(ends[0], ends[1], body, shape)
    arm_x = x - base_point(robot)
    turned = jnp.cross(arm_x, normal)
    row = normal @ arm.S.lin.stack() + turned @ arm.S.ang.stack()
    row = jnp.where(jnp.arange(n) <= link, row, 0.0)
    own = row @ now.qvel[:n]
    return row, own, own - normal @ (body.lin + jnp.cross(body.ang, x))


class Body(Pytree):
    """Pose and twist of a body outside the arm."""

    p: Float[Array, "*b 3"]
    """Position [m]."""
    R: Float[Array, "*b 3 3"]
    """Orientation."""
    lin: Float[Array, "*b 3"]
    """Velocity of its point at the world's origin [m/s]."""
    ang: Float[Array, "*b 3"]
    """Angular velocity [rad/s]."""


def _nearest(
    start: Array, end: Array, body: Body, half: Float[Array, " 3"]
) -> tuple[Array, Array]:
    """The point of a segment nearest to a box, and the direction from there to the box.

    The distance is convex along the segment: its slope is halved to zero. Rounding does
    not matter: a body's radius changes neither the point nor the direction.
    """

    def away(t: Array) -> tuple[Array, Array]:
        x = start + t * (end - start)
        local = body.R.T @ (x - body.p)
        return x, body.R @ (local - jnp.clip(local, -half, half))

    def halve(_, bounds):
        low, high = bounds
        middle = 0.5 * (low + high)
        rises = away(middle)[1] @ (end - start) > 0.0
        return jnp.where(rises, low, middle), jnp.where(rises, middle, high)

    zero = jnp.zeros((), start.dtype)
    low, high = jax.lax.fori_loop(0, HALVINGS, halve, (zero, zero + 1.0))
    x, outward = away(0.5 * (low + high))
    return x, -outward / jnp.maximum(jnp.linalg.norm(outward), 1e-9)


def _bodies(scene: Scene, moment: Moment) -> tuple[Body, Float[Array, "g 3"]]:
    """Geoms that hand or arm must not touch: frames, motions, and half sizes of cores.

    The core is what is left of a shape without its radius: a point, a segment, a box.
    """
    model, bodies = scene.model, object_states(scene.model, moment)
    geoms, half = np.unique(scene.other), []
    found = []
    for geom in geoms:
        body, size = bodies[model.geom_bodyid[geom]], model.geom_size[geom]
        place, turn = model.geom_pos[geom], _matrix(model.geom_quat[geom])
        kind = model.geom_type[geom]
        if kind == mujoco.mjtGeom.mjGEOM_PLANE:
            core, place = np.full(3, FAR), place - FAR * turn[:, 2]
        elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            core = np.zeros(3)
        elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            core = np.array([0.0, 0.0, size[1]])
        elif kind == mujoco.mjtGeom.mjGEOM_BOX:
            core = size
        else:
            place = place + turn @ model.geom_aabb[geom, :3]
            core = model.geom_aabb[geom, 3:]
        p, R = body.p + body.R @ place, body.R @ turn
        found.append(body.replace(p=p, R=R))
        half.append(core)
    dtype = moment.qpos.dtype
    stacked = jax.tree.map(lambda *x: jnp.stack(jnp.broadcast_arrays(*x)), *found)
    return jax.tree.map(lambda x: x.astype(dtype), stacked), jnp.asarray(half, dtype)


def object_states(model: mujoco.MjModel, moment: Moment) -> dict[int, Body]:
    """Pose and twist of every body outside the arm, by id.

    Args:
        model: The scene.
        moment: Physics.

    Returns:
        The arm's bodies are left out, and those on ball joints.
    """
    qpos, qvel = moment.qpos, moment.qvel
    zero, found = jnp.zeros(3, qpos.dtype), {}
    found[0] = Body(zero, jnp.eye(3, dtype=qpos.dtype), zero, zero)
    for body in range(1, model.nbody):
        above = found.get(int(model.body_parentid[body]))
        if above is None or model.body(body).name.startswith(ARM):
            continue
        number = int(model.body_mocapid[body])
        if number >= 0:
            place, speed = moment.centers[number], moment.velocity[number]
            found[body] = above.replace(p=place, lin=speed)
            continue
        state = above.replace(
            p=above.p + above.R @ model.body_pos[body],
            R=above.R @ _matrix(model.body_quat[body]),
        )
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            state = state and _moved(model, state, joint, qpos, qvel)
        if state is not None:
            found[body] = state
    return found


def _moved(
    model: mujoco.MjModel, body: Body, joint: int, qpos: Array, qvel: Array
) -> Body | None:
    """A body after one of its joints; None for a ball joint."""
    at, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    kind = model.jnt_type[joint]
    if kind == mujoco.mjtJoint.mjJNT_FREE:
        p, R = qpos[at : at + 3], quat_to_mat(qpos[at + 3 : at + 7])
        ang = R @ qvel[dof + 3 : dof + 6]
        return Body(p, R, qvel[dof : dof + 3] + jnp.cross(p, ang), ang)
    if kind == mujoco.mjtJoint.mjJNT_BALL:
        return None
    axis = body.R @ jnp.asarray(model.jnt_axis[joint], qpos.dtype)
    shift, speed = qpos[at] - model.qpos0[at], axis * qvel[dof]
    if kind == mujoco.mjtJoint.mjJNT_SLIDE:
        return body.replace(p=body.p + axis * shift, lin=body.lin + speed)
    anchor = body.p + body.R @ model.jnt_pos[joint]
    R = exp_so3(axis * shift) @ body.R
    return Body(
        anchor - R @ model.jnt_pos[joint],
        R,
        body.lin + jnp.cross(anchor, speed),
        body.ang + speed,
    )


def _matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix of a quaternion of the model."""
    found = np.zeros(9)
    mujoco.mju_quat2Mat(found, quat)
    return found.reshape(3, 3)
