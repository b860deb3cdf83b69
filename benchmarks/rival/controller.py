"""The rival's controllers: VICES and the RMP tree, one compiled loop over the batch.

MuJoCo has the kinematics, the inertia and the bias already; the rest is written out
for one arm and runs over the environments in parallel. A leaf out of range of its
obstacle is skipped.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange  # pyright: ignore[reportMissingImports]

from benchmarks.rival.task import (
    FAST,
    N,
    add_row,
    barrier,
    clamp,
    cross,
    dot,
    move,
    row_of,
    solve,
    twists,
    unpack,
)

VICES_KQ = 10.0
"""Stiffness of VICES' posture [1/s^2]."""


class Arm(NamedTuple):
    """Constants of the arm and its tree."""

    point_body: np.ndarray
    """Body that carries each control point, (p,)."""
    point_joint: np.ndarray
    """Joint that moves it, (p,)."""
    point_offset: np.ndarray
    """Its place in that body, (p, 3) [m]."""
    point_radius: np.ndarray
    """Radius, (p,) [m]."""
    capsule_geom: np.ndarray
    """Geom of each link capsule, (c,)."""
    capsule_joint: np.ndarray
    """Joint that moves it, (c,); -1 for the base."""
    capsule_size: np.ndarray
    """Its radius and half length, (c, 2) [m]."""
    pairs: np.ndarray
    """Capsule pairs (far, near) that are watched, (k, 2)."""
    site: int
    """Index of the end effector's site."""
    q_home: np.ndarray
    """Rest configuration, (n,) [rad]."""
    q_lower: np.ndarray
    """Lower limits, (n,) [rad]."""
    q_upper: np.ndarray
    """Upper limits, (n,) [rad]."""
    tau_max: np.ndarray
    """Torque limits, (n,) [N m]."""
    collision: np.ndarray
    """Barrier of the collision leaves, (9,): see `barrier`."""
    self_collision: np.ndarray
    """Barrier of the self-collision leaves."""
    joint_limit: np.ndarray
    """Barrier of the joint-limit leaf."""
    obstacle_relaxation: np.ndarray
    """Relaxation near obstacles: (min_weight, near, far)."""
    limit_relaxation: np.ndarray
    """Relaxation near joint limits."""
    posture: np.ndarray
    """(stiffness, damping, weight, the root's regulariser)."""
    table: float
    """Height of the table [m]."""


class Fields(NamedTuple):
    """What MuJoCo computed at the current states, batched."""

    qpos: np.ndarray
    qvel: np.ndarray
    xanchor: np.ndarray
    xaxis: np.ndarray
    xpos: np.ndarray
    xmat: np.ndarray
    geom_xpos: np.ndarray
    geom_xmat: np.ndarray
    site_xpos: np.ndarray
    site_xmat: np.ndarray
    M: np.ndarray
    qfrc_bias: np.ndarray


@njit(fastmath=FAST, cache=True)
def avoid_obstacles(arm, xpos, xmat, S, V, A, spheres, f, M):
    """Collision leaves of all control points; the least distance to a sphere."""
    x, v, a, g, row = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(N)
    up = np.array([0.0, 0.0, 1.0])
    reach = arm.collision[3] + arm.collision[4]
    nearest = np.inf
    for k in range(len(arm.point_body)):
        body, j, rho = arm.point_body[k], arm.point_joint[k], arm.point_radius[k]
        moved = False
        for i in range(3):
            x[i] = xpos[body, i] + dot(
                xmat[body, 3 * i : 3 * i + 3], arm.point_offset[k]
            )
        d = x[2] - arm.table - rho
        if d < reach:
            move(V, A, j, x, v, a)
            moved = True
            m, wanted = barrier(arm.collision, d, v[2])
            row_of(S, up, x, 0, j, row)
            add_row(f, M, row, j + 1, m, wanted - a[2])
        for o in range(len(spheres)):
            for i in range(3):
                g[i] = x[i] - spheres[o, i]
            norm = np.sqrt(dot(g, g))
            d = norm - spheres[o, 3] - rho
            nearest = min(nearest, d)
            if d >= reach:
                continue
            if not moved:
                move(V, A, j, x, v, a)
                moved = True
            for i in range(3):
                g[i] /= norm
            rate = dot(g, v)
            curvature = (dot(v, v) - rate * rate) / norm + dot(g, a)
            m, wanted = barrier(arm.collision, d, rate)
            row_of(S, g, x, 0, j, row)
            add_row(f, M, row, j + 1, m, wanted - curvature)
    return nearest


@njit(fastmath=FAST, cache=True)
def ends(arm, c, geom_xpos, geom_xmat, start, along):
    """Start and direction of a link capsule's axis."""
    geom, half = arm.capsule_geom[c], arm.capsule_size[c, 1]
    for i in range(3):
        z = geom_xmat[geom, 3 * i + 2] * half
        start[i] = geom_xpos[geom, i] - z
        along[i] = 2.0 * z


@njit(fastmath=FAST, cache=True)
def avoid_self(arm, geom_xpos, geom_xmat, S, V, A, f, M):
    """Collision leaves of the capsule pairs (Ericson, 2005, section 5.1.9)."""
    p, da, q, db = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    g, rel, acc, gdot = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    x, y, v, a = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    turn_a, turn_b, row = np.zeros(3), np.zeros(3), np.empty(N)
    reach = arm.self_collision[3] + arm.self_collision[4]
    for k in range(len(arm.pairs)):
        far, near = arm.pairs[k]
        ends(arm, far, geom_xpos, geom_xmat, p, da)
        ends(arm, near, geom_xpos, geom_xmat, q, db)
        for i in range(3):
            g[i] = p[i] - q[i]
        aa, bb, ab, ag, bg = (
            dot(da, da),
            dot(db, db),
            dot(da, db),
            dot(da, g),
            dot(db, g),
        )
        determinant = aa * bb - ab * ab
        s = 0.5
        if determinant > 1e-6 * aa * bb + 1e-9:
            s = clamp((ab * bg - ag * bb) / determinant)
        t = clamp((ab * s + bg) / bb) if bb > 1e-9 else 0.0
        s = clamp((ab * t - ag) / aa) if aa > 1e-9 else 0.0
        for i in range(3):
            x[i] = p[i] + s * da[i]
            y[i] = q[i] + t * db[i]
            g[i] = x[i] - y[i]
        norm = np.sqrt(dot(g, g))
        d = norm - arm.capsule_size[far, 0] - arm.capsule_size[near, 0]
        if d >= reach:
            continue
        j_far, j_near = arm.capsule_joint[far], arm.capsule_joint[near]
        move(V, A, j_far, x, rel, acc)
        move(V, A, j_near, y, v, a)
        cross(V[j_far, 3:], da, turn_a)
        turn_b[:] = 0.0
        if j_near >= 0:
            cross(V[j_near, 3:], db, turn_b)
        for i in range(3):
            rel[i] -= v[i]
            acc[i] -= a[i]
        # How the closest points slide along the axes: free ones stay perpendicular.
        free_s, free_t = 0.0 < s < 1.0, 0.0 < t < 1.0
        u, w = dot(rel, da) + dot(g, turn_a), dot(rel, db) + dot(g, turn_b)
        sdot = tdot = 0.0
        if free_s and free_t:
            sdot = (ab * w - bb * u) / determinant
            tdot = (aa * w - ab * u) / determinant
        elif free_s:
            sdot = -u / aa
        elif free_t:
            tdot = w / bb
        for i in range(3):
            gdot[i] = rel[i] + sdot * da[i] - tdot * db[i]
            acc[i] += sdot * turn_a[i] - tdot * turn_b[i]
        rate = dot(g, rel) / norm
        curvature = (dot(gdot, rel) + dot(g, acc) - rate * rate) / norm
        m, wanted = barrier(arm.self_collision, d, rate)
        for i in range(3):
            g[i] /= norm
        row_of(S, g, x, j_near + 1, j_far, row)
        add_row(f, M, row, j_far + 1, m, wanted - curvature)


@njit(fastmath=FAST, cache=True)
def weight(leaf, room):
    """Weight of the orientation at this distance."""
    min_weight, near, far = leaf[0], leaf[1], leaf[2]
    return min_weight ** min(max(far - room, 0.0) / (far - near), 1.0)


@njit(fastmath=FAST, cache=True)
def impedance(arm, fields, e, p_des, R_des, kp, S, V, pull, J):
    """Accelerations of the impedance target, (6,), and the Jacobian's rows."""
    site, R = fields.site_xpos[e, arm.site], fields.site_xmat[e, arm.site]
    last, v = V[N - 1], np.empty(3)
    for k in range(3):
        p, q = (k + 1) % 3, (k + 2) % 3
        v[k] = last[k] + last[3 + p] * site[q] - last[3 + q] * site[p]
        error = 0.0
        for c in range(3):
            error += R[3 * p + c] * R_des[q, c] - R[3 * q + c] * R_des[p, c]
        pull[k] = kp[k] * (p_des[k] - site[k]) - 2.0 * np.sqrt(kp[k]) * v[k]
        kd = 2.0 * np.sqrt(kp[3 + k])
        pull[3 + k] = 0.5 * kp[3 + k] * error - kd * last[3 + k]
        for j in range(N):
            J[k, j] = S[j, k] + S[j, 3 + p] * site[q] - S[j, 3 + q] * site[p]
            J[3 + k, j] = S[j, 3 + k]


@njit(parallel=True, fastmath=FAST, cache=True)
def rmp_vices(arm, fields, p_des, R_des, kp, spheres, tau):
    """Torques of the tree.

    Args:
        arm: Constants.
        fields: States of b environments.
        p_des: Targets, (b, 3) [m].
        R_des: Target orientations, (b, 3, 3).
        kp: Stiffness, position then orientation, (b, 6) [1/s^2].
        spheres: Centres and radii, (b, o, 4) [m].
        tau: Result, (b, n) [N m].
    """
    for e in prange(len(tau)):
        q, qd = fields.qpos[e], fields.qvel[e]
        S, V, A = np.empty((N, 6)), np.empty((N, 6)), np.empty((N, 6))
        f, M, Mq = np.zeros(N), np.zeros((N, N)), np.empty((N, N))
        pull, J = np.empty(6), np.empty((6, N))
        v, a = np.empty(3), np.empty(3)
        twists(fields.xanchor[e], fields.xaxis[e], qd, S, V, A)
        unpack(fields.M[e], Mq)
        body_clearance = avoid_obstacles(
            arm, fields.xpos[e], fields.xmat[e], S, V, A, spheres[e], f, M
        )
        avoid_self(arm, fields.geom_xpos[e], fields.geom_xmat[e], S, V, A, f, M)

        room = np.inf
        for j in range(N):
            below, above = q[j] - arm.q_lower[j], arm.q_upper[j] - q[j]
            room = min(room, below, above)
            m, wanted = barrier(arm.joint_limit, below, qd[j])
            f[j] += m * wanted
            M[j, j] += m
            m, wanted = barrier(arm.joint_limit, above, -qd[j])
            f[j] -= m * wanted
            M[j, j] += m
        turning = min(
            weight(arm.obstacle_relaxation, body_clearance),
            weight(arm.limit_relaxation, room),
        )

        impedance(arm, fields, e, p_des[e], R_des[e], kp[e], S, V, pull, J)
        move(V, A, N - 1, fields.site_xpos[e, arm.site], v, a)
        for k in range(3):
            add_row(f, M, J[k], N, 1.0, pull[k] - a[k])
            add_row(f, M, J[3 + k], N, turning, pull[3 + k] - A[N - 1, 3 + k])

        kq, kd, share, epsilon = arm.posture
        for i in range(N):
            for j in range(N):
                rest = kq * (arm.q_home[j] - q[j]) - kd * qd[j]
                f[i] += share * Mq[i, j] * rest
                M[i, j] += (share + epsilon) * Mq[i, j]
        solve(M, f)
        scale = 1.0
        for i in range(N):
            wanted = 0.0
            for j in range(N):
                wanted += Mq[i, j] * f[j]
            V[i, 0] = wanted
            limit = arm.tau_max[i]
            bias = min(max(fields.qfrc_bias[e, i], -limit), limit)
            V[i, 1] = bias
            left = limit - bias if wanted > 0.0 else limit + bias
            if abs(wanted) > left:
                scale = min(scale, left / abs(wanted))
        for i in range(N):
            limit = arm.tau_max[i]
            tau[e, i] = min(max(V[i, 1] + scale * V[i, 0], -limit), limit)


@njit(parallel=True, fastmath=FAST, cache=True)
def vices(arm, fields, p_des, R_des, kp, spheres, tau):
    """Torques of VICES; arguments as `rmp_vices`, the spheres are ignored."""
    for e in prange(len(tau)):
        q, qd = fields.qpos[e], fields.qvel[e]
        S, V, A = np.empty((N, 6)), np.empty((N, 6)), np.empty((N, 6))
        Mq, inertia, column = np.empty((N, N)), np.empty((N, N)), np.empty(N)
        pull, J, back = np.empty(6), np.empty((6, N)), np.empty((6, N))
        twists(fields.xanchor[e], fields.xaxis[e], qd, S, V, A)
        unpack(fields.M[e], Mq)
        impedance(arm, fields, e, p_des[e], R_des[e], kp[e], S, V, pull, J)
        for k in range(6):
            inertia[:] = Mq
            back[k] = J[k]
            solve(inertia, back[k])
        both, half, rest = np.empty((6, 6)), np.empty((3, 3)), np.empty(6)
        for i in range(6):
            rest[i] = 0.0
            for j in range(6):
                both[i, j] = 0.0
                for k in range(N):
                    both[i, j] += J[i, k] * back[j, k]
        for j in range(N):
            column[j] = VICES_KQ * (arm.q_home[j] - q[j])
            column[j] -= 2.0 * np.sqrt(VICES_KQ) * qd[j]
            for i in range(6):
                rest[i] += J[i, j] * column[j]
        for block in range(2):
            half[:] = both[3 * block : 3 * block + 3, 3 * block : 3 * block + 3]
            solve(half, pull[3 * block : 3 * block + 3])
        solve(both, rest)
        for i in range(N):
            total = fields.qfrc_bias[e, i]
            for j in range(N):
                total += Mq[i, j] * column[j]
            for k in range(6):
                total += J[k, i] * (pull[k] - rest[k])
            tau[e, i] = min(max(total, -arm.tau_max[i]), arm.tau_max[i])
